"""How much each hypothesis would explain of what a fit has left, to first order: moments and periods searched in full.

With what the fitted amounts can change projected out, a column c explains (c·r)² / (c·c) of the squared residuals r.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from bodyschema.effects import Effect, Identity
from bodyschema.effects.moments import settled
from bodyschema.interfaces.records import FloatArray

from .fit import LARGEST, SHORTEST_DRIFT, Fit
from .products import Products, System

# The finest ripple that is looked for.
_MOST_CYCLES = 100
# Half way between two shapes that are tried one explains so many times less at most: waves one over sinc² of a half.
_BETWEEN = 2.5
# Widths of a play that are tried [rad, m], and time constants as shares of the recording's time.
_WIDTHS = np.geomspace(2e-4, 0.15, 14)
_TIME_CONSTANTS = np.geomspace(SHORTEST_DRIFT, 4.0, 24)
# How much of what was missing is still missing at the next reading.
_MEMORIES = np.linspace(0.0, 0.9, 19)
# As so many independent shapes those of a smooth family count.
_COARSE = 5
# So many moments are tried, and all those beside the best of them.
_MOST_MOMENTS = 1000
# Rows that have to lie on either side of a moment.
_BESIDE = 8
# Twice the fall of the log-likelihood at the ends of a 95 % interval.
_AT_95 = 3.841
# A column of which so little is left beside what is fitted tells nothing.
_TOLD_APART = 1e-7


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
    """All hypotheses against one fit, as it is or without one of its causes.

    Args:
        besides: causes without each of which the fit is to be scanned, too; most of the work is the same.
    """

    def __init__(self, fit: Fit, besides: Sequence[Effect] = ()) -> None:
        self._fit, self._products, self._state = fit, Products(fit, besides), 0
        self._besides = tuple(cause.identity for cause in besides)
        self._before = {0: fit.run.measured}

    def without(self, cause: Effect) -> Scan:
        """The scan of the fit without one of `besides`, all others refitted to first order."""
        scan = copy(self)
        scan._state = 1 + self._besides.index(cause.identity)
        return scan

    def tolerates(self, effect: Effect) -> bool:
        """Whether the fit's background has such errors as well."""
        return self._fit.background.tolerates(effect)

    def candidates(self, hypotheses: Iterable[Effect], near: float = 0.0) -> list[Candidate]:
        """One for each hypothesis of which this data tell anything.

        Args:
            near: periods and time constants of what cannot explain so large a share of what the best of the others does
                are not sought finely.
        """
        found, most = [], 0.0
        for effect in sorted(hypotheses, key=lambda effect: len(effect.shapes)):
            candidate = self.candidate(effect, near * most)
            if candidate is not None and candidate.effect.is_possible and np.isfinite(candidate.gain):
                found.append(candidate)
                most = max(most, candidate.gain)
        return found

    def candidate(self, effect: Effect, least: float = 0.0) -> Candidate | None:
        """The hypothesis as it would explain most; None where nothing of it can be told.

        Args:
            least: the gain from which on its period or time constant is wanted as exactly as it can be told.
        """
        match effect.name:
            case "joint_ripple":
                return self._ripple(effect, least)
            case "encoder_jump" | "tool_slip" | "camera_moved":
                return self._moment(effect)
            case "backlash":
                return self._play(effect)
            case "thermal_drift":
                clock = self._fit.observations.motion.clock
                span = float(clock[-1] - clock[0])
                return self._finely(effect, span * _TIME_CONSTANTS, least)
            case "settling":
                return self._finely(effect, _MEMORIES, least)
            case _:
                gains, amounts, dofs = self._solved(self._linear(effect), effect)
                if not dofs[0]:
                    return None
                return Candidate(_with_amounts(effect, amounts[0]), float(gains[0]), int(dofs[0]))

    def in_full(self, candidate: Candidate) -> Candidate:
        """Return the candidate with the gain of its amounts themselves, where that is more than to first order.

        A turn of some degrees beside noise of a tenth of a millimetre is more than its tangent.
        """
        effects = [effect for effect in self._fit.simulation.effects if effect.identity != self._left_out]
        simulation, motion = self._fit.simulation, self._fit.observations.motion
        if self._state not in self._before:
            self._before[self._state] = simulation.with_effects(effects).run(motion).measured
        before = self._before[self._state]
        after = simulation.with_effects([*effects, candidate.effect]).run(motion).measured
        inner, toward, _ = self._products.of(self._fit.weighted((after - before)[:, :, None])).at(self._state)
        square = self._products.squares[self._state]
        explained = np.clip(toward[0, 0] ** 2 / max(float(inner[0, 0, 0]), 1e-300), 0.0, 0.999999 * square)
        gain = float(-3.0 * self._products.rows * np.log1p(-explained / square))
        return replace(candidate, gain=gain) if gain > candidate.gain else candidate

    @property
    def _left_out(self) -> Identity | None:
        return self._besides[self._state - 1] if self._state else None

    def best_pair(self, hypotheses: Iterable[Effect]) -> tuple[Candidate, Candidate] | None:
        """The two effects of one amount each that would explain most together; None where there are not two.

        What begins at a moment does so where it would explain most alone.
        """
        alone = [self._alone(effect) for effect in hypotheses if len(effect.amounts) == 1 and not effect.shapes]
        singles = [one for one in alone if one is not None]
        if len(singles) < 2:
            return None
        run = self._fit.run
        columns = np.concatenate([run.columns(one.effect)[:, :, one.effect.amounts] for one in singles], axis=2)
        inner, toward, raw = (part[0] for part in self._products.of(self._fit.weighted(columns)).at(self._state))
        # In units of each one's length beside what is fitted; two that are one are left out.
        lengths = np.sqrt(np.maximum(np.diag(inner), 0.0))
        told = lengths > np.sqrt(_TOLD_APART * raw)
        lengths = np.where(told, lengths, np.inf)
        shared = inner / np.outer(lengths, lengths)
        alone = toward / lengths
        apart = 1.0 - np.square(shared)
        squares = np.square(alone)[:, None] + np.square(alone) - 2.0 * shared * np.outer(alone, alone)
        usable = np.outer(told, told) & (apart > _TOLD_APART)
        explained = np.where(usable, squares / np.maximum(apart, _TOLD_APART), 0.0)
        one, other = np.unravel_index(int(np.argmax(explained)), explained.shape)
        if explained[one, other] <= 0.0:
            return None
        amounts = (alone[[one, other]] - shared[one, other] * alone[[other, one]]) / apart[one, other]
        rss = self._products.squares[self._state]
        gain = -3.0 * self._products.rows * np.log1p(-min(explained[one, other] / rss, 0.999999))
        values = amounts / lengths[[one, other]]
        pair = [
            replace(singles[k], effect=_with_amounts(singles[k].effect, values[[place]]), gain=float(gain), dof=1)
            for place, k in enumerate((int(one), int(other)))
        ]
        return pair[0], pair[1]

    def _alone(self, effect: Effect) -> Candidate | None:
        """An effect of one amount as one of a pair: with its moment where it has one; None where none is told."""
        if effect.kind.begins:
            return self._moment(effect)
        return None if effect.name == "backlash" else Candidate(effect, 0.0, 1)

    def _finely(self, effect: Effect, shapes: FloatArray, least: float) -> Candidate | None:
        """The best of an effect whose last number is its shape, over increasing shapes (m,), then between them."""
        # Without each cause the same coarse shapes are tried.
        gains, amounts, dofs = self._solved(self._products.kept(effect, lambda: self._each(effect, shapes)), effect)
        if not dofs.any():
            return None
        told, best = shapes[dofs > 0], int(np.argmax(np.where(dofs > 0, gains, -np.inf)))
        if self._times(float(gains[best]), _BETWEEN) >= least:
            place = int(np.searchsorted(told, shapes[best]))
            shapes = np.linspace(told[max(place - 1, 0)], told[min(place + 1, len(told) - 1)], 13)
            gains, amounts, dofs = self._solved(self._each(effect, shapes), effect)
            best = int(np.argmax(gains))
        values = np.append(amounts[best], shapes[best])
        return Candidate(effect.with_values(values), float(gains[best]), int(dofs[best]), _COARSE)

    def _each(self, effect: Effect, shapes: FloatArray) -> System:
        """For each shape (m,), which scales the same columns row by row."""
        run = self._fit.run
        if effect.name == "thermal_drift":
            constant = np.broadcast_to(np.eye(3), (len(run.motion), 3, 3))
            rows = self._products.rows_of(self._fit.weighted(constant))
            factors = [settled(run.motion, float(shape)) for shape in shapes]
        else:
            place, encoder = self._fit.simulation.place(effect), effect.kind.encoder
            assert encoder is not None
            rows = self._products.port(place.joint)
            shaped = (np.append(effect.values[:-1], shape) for shape in shapes)
            factors = [encoder.columns(run.readings, place, values)[:, 0] for values in shaped]
        return rows.scaled(np.stack(factors, axis=1))

    def _play(self, effect: Effect) -> Candidate | None:
        """Over widths: the shape's own size is the amount."""
        place, encoder = self._fit.simulation.place(effect), effect.kind.encoder
        assert encoder is not None

        def bent() -> System:
            by_width = [encoder.correction(self._fit.run.readings, place, np.array([w])) / w for w in _WIDTHS]
            return self._products.port(place.joint).scaled(np.stack(by_width, axis=1))

        gains, amounts, dofs = self._solved(self._products.kept(effect, bent), effect)
        # The width that the shape was made with, and the one that it would take.
        off = np.abs(np.log(np.maximum(amounts[:, 0], 1e-12) / _WIDTHS))
        gains = np.where(dofs > 0, np.where(off < np.log(3.0), gains, 0.5 * gains), -np.inf)
        best = int(np.argmax(gains))
        if not dofs[best]:
            return None
        return Candidate(effect.with_values(amounts[best]), float(gains[best]), int(dofs[best]), len(_WIDTHS))

    def _ripple(self, effect: Effect, least: float) -> Candidate | None:
        """Over all whole numbers of cycles a turn, then beside the best; of a slide, over those its path can tell."""
        place = self._fit.simulation.place(effect)
        span = max(float(np.ptp(self._fit.run.readings.q[:, place.joint])), 1e-6)
        first, step = (2.0, 1.0) if not place.prismatic else (1.0 / span, 1.0 / span)
        coarse: FloatArray = np.asarray(first + step * np.arange(_MOST_CYCLES - 1), dtype=np.float64)
        # A peak is as wide as what turns the phase by one over the range.
        width = 1.0 / span if place.prismatic else 2.0 * np.pi / span
        tried, cycles = self._best(self._products.kept(effect, lambda: self._rippled(effect, coarse)), effect), coarse
        if width < step or self._times(float(tried[1][tried[0]]), _BETWEEN) >= least:
            fine: FloatArray = coarse[tried[0]] + 0.5 * max(width, step) * np.linspace(-1.0, 1.0, 61)
            cycles = np.asarray(fine[fine > 0.5 * first], dtype=np.float64)
            tried = self._best(self._rippled(effect, cycles), effect)
        best, gains, amounts, dof = tried
        if not dof:
            return None
        values = np.array([*amounts, cycles[best]])
        return Candidate(effect.with_values(values), float(gains[best]), dof, 2 * len(coarse))

    def _times(self, gain: float, factor: float) -> float:
        """The gain of what explains so many times the squares of what has this gain."""
        share = -np.expm1(-gain / (3.0 * self._products.rows))
        return float(-3.0 * self._products.rows * np.log1p(-min(factor * share, 0.999999)))

    def _rippled(self, effect: Effect, cycles: FloatArray) -> System:
        """For each of equally spaced numbers of cycles (m,)."""
        place = self._fit.simulation.place(effect)
        angle = self._fit.run.readings.q[:, place.joint] * (2.0 * np.pi if place.prismatic else 1.0)
        # exp(i cycles angle), each from the one before.
        waves = np.empty((len(angle), len(cycles)), dtype=np.complex128)
        waves[:, 0] = np.exp(1j * cycles[0] * angle)
        waves[:, 1:] = np.exp(1j * (cycles[1] - cycles[0]) * angle)[:, None]
        np.multiply.accumulate(waves, axis=1, out=waves)
        return self._products.port(place.joint).waved(waves)

    def _moment(self, effect: Effect) -> Candidate | None:
        """Over moments between two rows: some of them, then all beside the best."""
        n = len(self._fit.left)
        if n < 2 * _BESIDE + 1:
            return None
        begun = effect.with_values(np.append(effect.values[:-1], -np.inf))

        def since(rows: range) -> System:
            columns = self._fit.weighted(self._fit.run.columns(begun)[:, :, effect.amounts])
            return self._products.since(columns, rows)

        step = 1 + n // _MOST_MOMENTS
        some = range(_BESIDE, n - _BESIDE, step)
        best, gains, amounts, dof = self._best(self._products.kept(effect, lambda: since(some)), effect)
        if not dof:
            return None
        tried, row = np.asarray(some), some[best]
        if step > 1:
            beside = range(max(row - step + 1, _BESIDE), min(row + step, n - _BESIDE))
            best, closer, amounts, dof = self._best(since(beside), effect)
            row = beside[best]
            tried, first = np.unique(np.append(tried, beside), return_index=True)
            gains = np.append(gains, closer)[first]
        clock = self._fit.observations.motion.clock
        values = np.append(amounts, 0.5 * (clock[row - 1] + clock[row]))
        interval = _interval(0.5 * (clock[tried - 1] + clock[tried]), gains)
        return Candidate(effect.with_values(values), float(gains.max()), dof, n - 2 * _BESIDE, interval)

    def _linear(self, effect: Effect) -> System:
        """The system of an effect that has amounts alone."""

        def linear() -> System:
            encoder = effect.kind.encoder
            if encoder is None:
                return self._products.of(self._fit.weighted(self._fit.run.columns(effect)[:, :, effect.amounts]))
            place = self._fit.simulation.place(effect)
            factors = encoder.columns(self._fit.run.readings, place, effect.values)[:, effect.amounts]
            return self._products.port(place.joint).mixed(factors)

        return self._products.kept(effect, linear)

    def as_it_is(self, effect: Effect) -> float:
        """`Candidate.gain` of an effect with the moment, period or width that it has."""
        columns = self._fit.weighted(self._fit.run.columns(effect)[:, :, effect.amounts])
        return float(self._solved(self._products.of(columns), effect)[0][0])

    def _solved(self, system: System, effect: Effect) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gains (m,), amounts (m, k) and degrees of freedom (m,) of m systems."""
        inner, gradient, raw = system.at(self._state)
        gains, amounts = self._gains(inner, gradient, effect)
        dofs = self._dofs(inner, raw, effect)
        return np.where(dofs > 0, gains, 0.0), amounts, dofs

    def _best(self, system: System, effect: Effect) -> tuple[int, FloatArray, FloatArray, int]:
        """As `_solved`, of many systems: which is the best, gains (m,), its amounts (k,) and degrees of freedom."""
        inner, gradient, raw = system.at(self._state)
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
        square = self._products.squares[self._state]
        explained = np.clip(np.einsum("ma,ma->m", amounts, gradient), 0.0, 0.999999 * square)
        return -3.0 * self._products.rows * np.log1p(-explained / square), amounts

    def _dofs(self, inner: FloatArray, raw: FloatArray, effect: Effect) -> FloatArray:
        """Degrees of freedom (m,)."""
        unit = _units(effect)
        shares = _eigenvalues(inner / np.sqrt(np.maximum(raw[:, :, None] * raw[:, None, :], 1e-300)))
        told = _eigenvalues(inner * unit[:, None] * unit) > 10.0 * self._fit.noise.sigma**2
        return ((shares > _TOLD_APART) & told).sum(axis=1)


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
