"""How much each hypothesis would explain of what a fit has left, to first order: moments and periods searched in full.

With what the fitted amounts can change projected out, a column c explains (c·r)² / (c·c) of the squared residuals r.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from effects import Effect
from effects.simulation import settled
from interfaces.records import FloatArray

from .fit import LARGEST, ROUNDED, SHORTEST_DRIFT, Fit

# The finest ripple that is looked for.
_MOST_CYCLES = 100
# Widths of a play that are tried [rad, m], and time constants as shares of the recording's time.
_WIDTHS = np.geomspace(2e-4, 0.15, 14)
_TIME_CONSTANTS = np.geomspace(SHORTEST_DRIFT, 4.0, 24)
# How much of what was missing is still missing at the next reading.
_MEMORIES = np.linspace(0.0, 0.9, 19)
# As so many independent shapes those of a smooth family count.
_COARSE = 5
# Rows that have to lie on either side of a moment.
_BESIDE = 8
# Twice the fall of the log-likelihood at the ends of a 95 % interval.
_AT_95 = 3.841
# A column of which so little is left beside what is fitted tells nothing.
_TOLD_APART = 1e-7


# Inner products (m, k, k) beside what is fitted, gradients (m, k) and raw squares (m, k) of m systems.
_System = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis as it would explain most.

    Attributes:
        effect: with the amounts of the linear fit, and the moment or period found.
        gain: twice the rise of the log-likelihood.
        dof: how many amounts of it the data tell.
        trials: among how many moments or periods it was chosen.
        interval: where else the moment may be, at 95 %; None for an effect that has none.
    """

    effect: Effect
    gain: float
    dof: int
    trials: int = 1
    interval: tuple[float, float] | None = None


class Scan:
    """All hypotheses against one fit."""

    def __init__(self, fit: Fit) -> None:
        self._fit = fit
        self._left = fit.left
        self._basis = fit.orthogonal
        basis = self._basis.reshape(self._left.size, self._basis.shape[2])
        flat = fit.left.ravel()
        self._left = (flat - basis @ (basis.T @ flat)).reshape(fit.left.shape)
        self._rows = float(fit.noise.weights.sum())
        # A simulation's own output leaves nothing, or what is rounded.
        self._rss = max(float(np.square(self._left).sum()), 3.0 * self._rows * ROUNDED**2)
        self._ports: dict[int, _Rows] = {}

    def candidates(self, hypotheses: Iterable[Effect]) -> list[Candidate]:
        """One for each hypothesis of which this data tell anything."""
        found = []
        for effect in hypotheses:
            candidate = self.candidate(effect)
            if candidate is not None and candidate.effect.is_possible and np.isfinite(candidate.gain):
                found.append(candidate)
        return found

    def candidate(self, effect: Effect) -> Candidate | None:
        """The hypothesis as it would explain most; None where nothing of it can be told."""
        match effect.name:
            case "joint_ripple":
                return self._ripple(effect)
            case "encoder_jump" | "tool_slip" | "camera_moved":
                return self._moment(effect)
            case "backlash":
                return self._play(effect)
            case "thermal_drift":
                clock = self._fit.observations.motion.clock
                span = float(clock[-1] - clock[0])
                return self._finely(effect, span * _TIME_CONSTANTS)
            case "settling":
                return self._finely(effect, _MEMORIES)
            case _:
                gains, amounts, dofs = self._solved(*self._linear(effect), effect)
                if not dofs[0]:
                    return None
                return Candidate(_with_amounts(effect, amounts[0]), float(gains[0]), int(dofs[0]))

    def best_pair(self, hypotheses: Iterable[Effect]) -> tuple[Candidate, Candidate] | None:
        """The two effects of one number each that would explain most together; None where there are not two."""
        singles = [effect for effect in hypotheses if len(effect.parameters) == 1]
        singles = [effect for effect in singles if effect.parameters[0].is_amount and effect.name != "backlash"]
        if len(singles) < 2:
            return None
        columns = np.concatenate([self._fit.run.columns(effect) for effect in singles], axis=2)
        flat = self._fit.weighted(columns).reshape(self._left.size, -1)
        removed = self._basis.reshape(self._left.size, -1).T @ flat
        toward = flat.T @ self._left.ravel()
        # In units of each one's length beside what is fitted; two that are one are left out.
        inner = flat.T @ flat
        lengths = np.sqrt(np.maximum(np.diag(inner) - np.square(removed).sum(axis=0), 0.0))
        told = lengths > np.sqrt(_TOLD_APART * np.diag(inner))
        lengths = np.where(told, lengths, np.inf)
        shared = (inner - removed.T @ removed) / np.outer(lengths, lengths)
        alone = toward / lengths
        apart = 1.0 - np.square(shared)
        squares = np.square(alone)[:, None] + np.square(alone) - 2.0 * shared * np.outer(alone, alone)
        usable = np.outer(told, told) & (apart > _TOLD_APART)
        explained = np.where(usable, squares / np.maximum(apart, _TOLD_APART), 0.0)
        one, other = np.unravel_index(int(np.argmax(explained)), explained.shape)
        if explained[one, other] <= 0.0:
            return None
        amounts = (alone[[one, other]] - shared[one, other] * alone[[other, one]]) / apart[one, other]
        gain = -3.0 * self._rows * np.log1p(-min(explained[one, other] / self._rss, 0.999999))
        values = amounts / lengths[[one, other]]
        pair = [
            Candidate(_with_amounts(singles[k], values[[place]]), float(gain), 1)
            for place, k in enumerate((int(one), int(other)))
        ]
        return pair[0], pair[1]

    def _finely(self, effect: Effect, shapes: FloatArray) -> Candidate | None:
        """The best of an effect whose last number is its shape, over increasing shapes (m,), then between them."""
        gains, _, dofs = self._each(effect, shapes)
        if not dofs.any():
            return None
        told, gains = shapes[dofs > 0], gains[dofs > 0]
        place = int(np.argmax(gains))
        fine = np.linspace(told[max(place - 1, 0)], told[min(place + 1, len(told) - 1)], 13)
        gains, amounts, dofs = self._each(effect, fine)
        best = int(np.argmax(gains))
        values = np.append(amounts[best], fine[best])
        return Candidate(effect.with_values(values), float(gains[best]), int(dofs[best]), _COARSE)

    def _each(self, effect: Effect, shapes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """`_solved` for each shape (m,), which scales the same columns row by row."""
        run = self._fit.run
        if effect.name == "thermal_drift":
            constant = np.broadcast_to(np.eye(3), (len(run.motion), 3, 3))
            rows = self._rows_of(self._fit.weighted(constant))
            factors = [settled(run.motion, float(shape)) for shape in shapes]
        else:
            place, encoder = self._fit.simulation.place(effect), effect.kind.encoder
            assert encoder is not None
            rows = self._port(place.joint)
            shaped = (np.append(effect.values[:-1], shape) for shape in shapes)
            factors = [encoder.columns(run.readings, place, values)[:, 0] for values in shaped]
        return self._solved(*rows.scaled(np.stack(factors, axis=1)), effect)

    def _play(self, effect: Effect) -> Candidate | None:
        """Over widths: the shape's own size is the amount."""
        place, encoder = self._fit.simulation.place(effect), effect.kind.encoder
        assert encoder is not None
        bent = [encoder.correction(self._fit.run.readings, place, np.array([w])) / w for w in _WIDTHS]
        gains, amounts, dofs = self._solved(*self._port(place.joint).scaled(np.stack(bent, axis=1)), effect)
        # The width that the shape was made with, and the one that it would take.
        off = np.abs(np.log(np.maximum(amounts[:, 0], 1e-12) / _WIDTHS))
        gains = np.where(dofs > 0, np.where(off < np.log(3.0), gains, 0.5 * gains), -np.inf)
        best = int(np.argmax(gains))
        if not dofs[best]:
            return None
        return Candidate(effect.with_values(amounts[best]), float(gains[best]), int(dofs[best]), len(_WIDTHS))

    def _ripple(self, effect: Effect) -> Candidate | None:
        """Over all whole numbers of cycles a turn, then beside the best; of a slide, over those its path can tell."""
        place = self._fit.simulation.place(effect)
        span = max(float(np.ptp(self._fit.run.readings.q[:, place.joint])), 1e-6)
        first, step = (2.0, 1.0) if not place.prismatic else (1.0 / span, 1.0 / span)
        coarse = first + step * np.arange(_MOST_CYCLES - 1)
        nearest = self._rippled(effect, np.asarray(coarse, dtype=np.float64))[0]
        # A peak is as wide as what turns the phase by one over the range.
        width = 1.0 / span if place.prismatic else 2.0 * np.pi / span
        fine: FloatArray = coarse[nearest] + 0.5 * max(width, step) * np.linspace(-1.0, 1.0, 61)
        fine = fine[fine > 0.5 * first]
        best, gains, amounts, dof = self._rippled(effect, np.asarray(fine, dtype=np.float64))
        if not dof:
            return None
        values = np.array([*amounts, fine[best]])
        return Candidate(effect.with_values(values), float(gains[best]), dof, 2 * len(coarse))

    def _rippled(self, effect: Effect, cycles: FloatArray) -> tuple[int, FloatArray, FloatArray, int]:
        """`_best` for each of equally spaced numbers of cycles (m,)."""
        place = self._fit.simulation.place(effect)
        angle = self._fit.run.readings.q[:, place.joint] * (2.0 * np.pi if place.prismatic else 1.0)
        # exp(i cycles angle), each from the one before.
        waves = np.empty((len(angle), len(cycles)), dtype=np.complex128)
        waves[:, 0] = np.exp(1j * cycles[0] * angle)
        waves[:, 1:] = np.exp(1j * (cycles[1] - cycles[0]) * angle)[:, None]
        np.multiply.accumulate(waves, axis=1, out=waves)
        rows = self._port(place.joint)
        square = rows.inner[:, 0]
        doubled = square @ np.square(waves)
        inner = np.empty((len(cycles), 2, 2))
        inner[:, 0, 0], inner[:, 1, 1] = 0.5 * (square.sum() - doubled.real), 0.5 * (square.sum() + doubled.real)
        inner[:, 0, 1] = inner[:, 1, 0] = 0.5 * doubled.imag
        raw = np.einsum("maa->ma", inner).copy()
        # Cosines and sines take turns.
        flat = waves.view(np.float64)
        removed = (flat.T @ rows.onto).reshape(len(cycles), 2, -1)[:, ::-1]
        inner -= removed @ np.swapaxes(removed, 1, 2)
        gradient = (flat.T @ rows.toward[:, 0]).reshape(-1, 2)[:, ::-1]
        return self._best(inner, gradient, raw, effect)

    def _moment(self, effect: Effect) -> Candidate | None:
        """Over all moments between two rows."""
        n = len(self._left)
        if n < 2 * _BESIDE + 1:
            return None
        clock = self._fit.observations.motion.clock
        begun = effect.with_values(np.append(effect.values[:-1], -np.inf))
        rows = self._rows_of(self._fit.weighted(self._fit.run.columns(begun)[:, :, effect.amounts]))
        k = rows.toward.shape[1]
        after = slice(_BESIDE, n - _BESIDE)

        def since(parts: FloatArray) -> FloatArray:
            return np.cumsum(parts[::-1], axis=0)[::-1][after]

        inner = since(rows.inner).reshape(-1, k, k)
        raw = np.einsum("taa->ta", inner).copy()
        removed = since(rows.onto).reshape(len(inner), k, -1)
        inner = inner - removed @ np.swapaxes(removed, 1, 2)
        best, gains, amounts, dof = self._best(inner, since(rows.toward), raw, effect)
        if not dof:
            return None
        row = best + _BESIDE
        moment = 0.5 * (clock[row - 1] + clock[row])
        values = np.append(amounts, moment)
        interval = _interval(0.5 * (clock[_BESIDE - 1 : n - _BESIDE - 1] + clock[_BESIDE : n - _BESIDE]), gains)
        return Candidate(effect.with_values(values), float(gains[best]), dof, len(gains), interval)

    def _linear(self, effect: Effect) -> _System:
        """The system of an effect that has amounts alone."""
        encoder = effect.kind.encoder
        if encoder is not None:
            place = self._fit.simulation.place(effect)
            factors = encoder.columns(self._fit.run.readings, place, effect.values)[:, effect.amounts]
            return self._port(place.joint).mixed(factors)
        columns = self._fit.weighted(self._fit.run.columns(effect)[:, :, effect.amounts])
        flat = columns.reshape(self._left.size, -1)
        inner = flat.T @ flat
        removed = flat.T @ self._basis.reshape(self._left.size, -1)
        return (inner - removed @ removed.T)[None], (flat.T @ self._left.ravel())[None], np.diag(inner)[None]

    def _solved(
        self, inner: FloatArray, gradient: FloatArray, raw: FloatArray, effect: Effect
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gains (m,), amounts (m, k) and degrees of freedom (m,) of m systems (m, k, k), of raw squares (m, k)."""
        gains, amounts = self._gains(inner, gradient, effect)
        dofs = self._dofs(inner, raw, effect)
        return np.where(dofs > 0, gains, 0.0), amounts, dofs

    def _best(
        self, inner: FloatArray, gradient: FloatArray, raw: FloatArray, effect: Effect
    ) -> tuple[int, FloatArray, FloatArray, int]:
        """As `_solved`, of many systems: which is the best, gains (m,), its amounts (k,) and degrees of freedom."""
        gains, amounts = self._gains(inner, gradient, effect)
        best = int(np.argmax(gains))
        # Only where the data tell nothing of the best are all others asked whether they tell more.
        if not (dof := int(self._dofs(inner[[best]], raw[[best]], effect)[0])):
            dofs = self._dofs(inner, raw, effect)
            gains = np.where(dofs > 0, gains, 0.0)
            best = int(np.argmax(gains))
            dof = int(dofs[best])
        return best, gains, amounts[best], dof

    def _gains(self, inner: FloatArray, gradient: FloatArray, effect: Effect) -> tuple[FloatArray, FloatArray]:
        """Gains (m,) and amounts (m, k)."""
        sigma2, unit = self._fit.noise.sigma**2, _units(effect)
        scaled = inner * unit[:, None] * unit
        if len(unit) == 1:
            solved = gradient * unit / (scaled[:, 0] + sigma2)
        else:
            solved = np.linalg.solve(scaled + sigma2 * np.eye(len(unit)), (gradient * unit)[:, :, None])[:, :, 0]
        amounts = solved * unit
        explained = np.einsum("ma,ma->m", amounts, gradient)
        explained = np.clip(explained, 0.0, 0.999999 * self._rss)
        return -3.0 * self._rows * np.log1p(-explained / self._rss), amounts

    def _dofs(self, inner: FloatArray, raw: FloatArray, effect: Effect) -> FloatArray:
        """Degrees of freedom (m,)."""
        unit = _units(effect)
        shares = _eigenvalues(inner / np.sqrt(np.maximum(raw[:, :, None] * raw[:, None, :], 1e-300)))
        told = _eigenvalues(inner * unit[:, None] * unit) > 10.0 * self._fit.noise.sigma**2
        return ((shares > _TOLD_APART) & told).sum(axis=1)

    def _port(self, joint: int) -> _Rows:
        """How the weighted prediction moves with a joint."""
        if joint not in self._ports:
            self._ports[joint] = self._rows_of(self._fit.weighted(self._fit.run.by_joint[:, :, [joint]]))
        return self._ports[joint]

    def _rows_of(self, columns: FloatArray) -> _Rows:
        n, _, k = columns.shape
        turned = np.swapaxes(columns, 1, 2)
        toward = (turned @ self._left[:, :, None])[:, :, 0]
        return _Rows((turned @ columns).reshape(n, k * k), (turned @ self._basis).reshape(n, -1), toward)


@dataclass(frozen=True, eq=False)
class _Rows:
    """What each row adds to the normal equations of columns (n, 3, k).

    Attributes:
        inner: products with one another (n, k k).
        onto: with what the fitted amounts can change (n, k r).
        toward: with what is left (n, k).
    """

    inner: FloatArray
    onto: FloatArray
    toward: FloatArray

    def scaled(self, factors: FloatArray) -> _System:
        """Inner products (m, k, k) beside what is fitted, gradients and raw squares (m, k) of rows times (n, m)."""
        k = self.toward.shape[1]
        inner = (np.square(factors).T @ self.inner).reshape(-1, k, k)
        raw = np.einsum("maa->ma", inner).copy()
        removed = (factors.T @ self.onto).reshape(len(inner), k, -1)
        return inner - removed @ np.swapaxes(removed, 1, 2), factors.T @ self.toward, raw

    def mixed(self, factors: FloatArray) -> _System:
        """The one system of k columns that are each this single column times factors (n, k), row by row."""
        inner, removed = factors.T @ (self.inner * factors), factors.T @ self.onto
        return (inner - removed @ removed.T)[None], (factors.T @ self.toward).T, np.diag(inner)[None]


def _units(effect: Effect) -> FloatArray:
    """Of an effect's amounts (k,): each as large as can be expected."""
    return LARGEST * np.array([effect.parameters[j].usual for j in effect.amounts])


def _eigenvalues(matrices: FloatArray) -> FloatArray:
    """Of symmetric matrices (m, k, k), increasing (m, k)."""
    values = matrices[:, 0] if matrices.shape[1] == 1 else np.linalg.eigvalsh(matrices)
    return np.asarray(values, dtype=np.float64)


def _interval(shapes: FloatArray, gains: FloatArray) -> tuple[float, float]:
    """The first and the last of the shapes (m,) that are not less probable than 95 % of the best allow."""
    near = np.flatnonzero(gains > gains.max() - _AT_95)
    return float(shapes[near[0]]), float(shapes[near[-1]])


def _with_amounts(effect: Effect, amounts: FloatArray) -> Effect:
    values = effect.values.copy()
    values[effect.amounts] = amounts
    return effect.with_values(values)
