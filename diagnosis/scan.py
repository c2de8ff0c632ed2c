"""How much each hypothesis would explain of what a fit has left, to first order: moments and periods searched in full.

With what the fitted amounts can change projected out, a column c explains (c·r)² / (c·c) of the squared residuals r.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from effects import Effect
from interfaces.records import FloatArray

from .fit import LARGEST, Fit

# The finest ripple that is looked for.
_MOST_CYCLES = 100
# Widths of a play that are tried [rad, m], and time constants as shares of the recording's time.
_WIDTHS = np.geomspace(2e-4, 0.15, 14)
_TIME_CONSTANTS = np.geomspace(0.02, 4.0, 24)
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


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis as it would explain most.

    Attributes:
        effect: with the amounts of the linear fit, and the moment or period found.
        gain: twice the rise of the log-likelihood.
        dof: how many amounts of it the data tell.
        trials: among how many moments or periods it was chosen.
        interval: where else the moment or period may be, at 95 %; None for an effect that has none.
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
        self._rss = float(np.square(self._left).sum())
        self._rows = float(fit.noise.weights.sum())

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
                return self._shapes(effect, [np.array([w]) for w in _WIDTHS], scaled=True)
            case "thermal_drift":
                clock = self._fit.observations.motion.clock
                span = float(clock[-1] - clock[0])
                return self._finely(effect, span * _TIME_CONSTANTS)
            case "settling":
                return self._finely(effect, _MEMORIES)
            case _:
                return self._shapes(effect, [effect.values])

    def _finely(self, effect: Effect, shapes: FloatArray) -> Candidate | None:
        """The best of an effect whose last number is its shape, over increasing shapes (m,), then between them."""
        coarse = self._each(effect, shapes)
        if not coarse:
            return None
        place = int(np.argmax([candidate.gain for _, candidate in coarse]))
        between = np.linspace(coarse[max(place - 1, 0)][0], coarse[min(place + 1, len(coarse) - 1)][0], 13)
        fine = self._each(effect, np.asarray(between, dtype=np.float64)) or coarse
        gains = np.array([candidate.gain for _, candidate in fine])
        interval = _interval(np.array([shape for shape, _ in fine]), gains)
        return replace(fine[int(np.argmax(gains))][1], trials=_COARSE, interval=interval)

    def _each(self, effect: Effect, shapes: FloatArray) -> list[tuple[float, Candidate]]:
        tried = [(float(s), self._shapes(effect, [np.append(effect.values[:-1], s)])) for s in shapes]
        return [(shape, candidate) for shape, candidate in tried if candidate is not None]

    def _shapes(self, effect: Effect, shapes: list[FloatArray], *, scaled: bool = False) -> Candidate | None:
        """The best of some shapes. `scaled`: the shape's own size is the amount, as a play's width."""
        best = None
        for values in shapes:
            shaped = effect.with_values(values)
            if scaled:
                place = self._fit.simulation.place(effect)
                assert effect.kind.encoder is not None
                bent = effect.kind.encoder.correction(self._fit.run.readings, place, values) / values[0]
                columns = self._ports[place.joint][:, :, None] * bent[:, None, None]
            else:
                columns = self._fit.weighted(self._fit.run.columns(shaped)[:, :, effect.amounts])
            gain, amounts, dof = self._explained(columns, shaped)
            if scaled:
                # The width that the shape was made with, and the one that it would take.
                off = abs(np.log(max(amounts[0], 1e-12) / values[0]))
                gain = gain if off < np.log(3.0) else 0.5 * gain
            if dof and (best is None or gain > best.gain):
                best = Candidate(_with_amounts(shaped, amounts), gain, dof, len(shapes))
        return best

    def _ripple(self, effect: Effect) -> Candidate | None:
        """Over all whole numbers of cycles a turn, then beside the best; of a slide, over those its path can tell."""
        place = self._fit.simulation.place(effect)
        span = max(float(np.ptp(self._fit.run.readings.q[:, place.joint])), 1e-6)
        first, step = (2.0, 1.0) if not place.prismatic else (1.0 / span, 1.0 / span)
        coarse = first + step * np.arange(_MOST_CYCLES - 1)
        gains, _, _ = self._rippled(effect, np.asarray(coarse, dtype=np.float64))
        # A peak is as wide as what turns the phase by one over the range.
        width = 1.0 / span if place.prismatic else 2.0 * np.pi / span
        fine: FloatArray = coarse[int(np.argmax(gains))] + 0.5 * max(width, step) * np.linspace(-1.0, 1.0, 61)
        fine = fine[fine > 0.5 * first]
        gains, amounts, dofs = self._rippled(effect, np.asarray(fine, dtype=np.float64))
        best = int(np.argmax(gains))
        if not dofs[best]:
            return None
        values = np.array([*amounts[best], fine[best]])
        interval = _interval(fine, gains)
        return Candidate(effect.with_values(values), float(gains[best]), int(dofs[best]), 2 * len(coarse), interval)

    def _rippled(self, effect: Effect, cycles: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """`_solved` for each number of cycles (m,)."""
        place = self._fit.simulation.place(effect)
        q = self._fit.run.readings.q[:, place.joint]
        phases = q[:, None] * cycles * (2.0 * np.pi if place.prismatic else 1.0)
        port = self._ports[place.joint]
        onto = np.einsum("nir,ni->nr", self._basis, port)
        square, with_left = np.square(port).sum(axis=1), (port * self._left).sum(axis=1)
        sine, cosine = np.sin(phases), np.cos(phases)
        inner = np.empty((len(cycles), 2, 2))
        inner[:, 0, 0], inner[:, 1, 1] = square @ np.square(sine), square @ np.square(cosine)
        inner[:, 0, 1] = inner[:, 1, 0] = square @ (sine * cosine)
        raw = np.einsum("maa->ma", inner).copy()
        removed = np.stack([sine.T @ onto, cosine.T @ onto], axis=1)
        inner -= removed @ np.swapaxes(removed, 1, 2)
        gradient = np.stack([with_left @ sine, with_left @ cosine], axis=1)
        return self._solved(inner, gradient, raw, effect)

    def _moment(self, effect: Effect) -> Candidate | None:
        """Over all moments between two rows."""
        n = len(self._left)
        if n < 2 * _BESIDE + 1:
            return None
        clock = self._fit.observations.motion.clock
        begun = effect.with_values(np.append(effect.values[:-1], -np.inf))
        columns = self._fit.weighted(self._fit.run.columns(begun)[:, :, effect.amounts])
        k = columns.shape[2]
        after = slice(_BESIDE, n - _BESIDE)

        def since(parts: FloatArray) -> FloatArray:
            return np.cumsum(parts[::-1], axis=0)[::-1][after]

        inner = since(np.einsum("nia,nib->nab", columns, columns))
        raw = np.einsum("taa->ta", inner).copy()
        removed = since(np.einsum("nia,nir->nar", columns, self._basis).reshape(n, -1)).reshape(len(inner), k, -1)
        inner = inner - removed @ np.swapaxes(removed, 1, 2)
        gradient = since(np.einsum("nia,ni->na", columns, self._left))
        gains, amounts, dofs = self._solved(inner, gradient, raw, effect)
        best = int(np.argmax(gains))
        if not dofs[best]:
            return None
        row = best + _BESIDE
        moment = 0.5 * (clock[row - 1] + clock[row])
        values = np.append(amounts[best], moment)
        interval = _interval(0.5 * (clock[_BESIDE - 1 : n - _BESIDE - 1] + clock[_BESIDE : n - _BESIDE]), gains)
        return Candidate(effect.with_values(values), float(gains[best]), int(dofs[best]), len(gains), interval)

    def _explained(self, columns: FloatArray, effect: Effect) -> tuple[float, FloatArray, int]:
        inner = np.einsum("nia,nib->ab", columns, columns)
        removed = np.einsum("nia,nir->ar", columns, self._basis)
        gradient = np.einsum("nia,ni->a", columns, self._left)
        raw = np.diag(inner).copy()
        gains, amounts, dofs = self._solved((inner - removed @ removed.T)[None], gradient[None], raw[None], effect)
        return float(gains[0]), amounts[0], int(dofs[0])

    def _solved(
        self, inner: FloatArray, gradient: FloatArray, raw: FloatArray, effect: Effect
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gains (m,), amounts (m, k) and degrees of freedom (m,) of m systems (m, k, k), of raw squares (m, k)."""
        sigma2 = self._fit.noise.sigma**2
        usual = np.array([effect.parameters[j].usual for j in effect.amounts])
        # In units in which an amount that is as large as can be expected is one.
        unit = LARGEST * usual
        scaled = inner * unit[:, None] * unit + sigma2 * np.eye(len(unit))
        solved = np.linalg.solve(scaled, (gradient * unit)[:, :, None])[:, :, 0]
        amounts = solved * unit
        explained = np.einsum("ma,ma->m", amounts, gradient)
        explained = np.clip(explained, 0.0, 0.999999 * self._rss)
        shares = np.linalg.eigvalsh(inner / np.sqrt(np.maximum(raw[:, :, None] * raw[:, None, :], 1e-300)))
        told = np.linalg.eigvalsh(inner * unit[:, None] * unit) > 10.0 * sigma2
        dofs = ((shares > _TOLD_APART) & told).sum(axis=1)
        gains = -3.0 * self._rows * np.log1p(-explained / self._rss)
        return np.where(dofs > 0, gains, 0.0), amounts, dofs

    @cached_property
    def _ports(self) -> FloatArray:
        """How the weighted prediction moves with each joint (d, n, 3)."""
        return np.moveaxis(self._fit.weighted(self._fit.run.by_joint), 2, 0)


def _interval(shapes: FloatArray, gains: FloatArray) -> tuple[float, float]:
    """The first and the last of the shapes (m,) that are not less probable than 95 % of the best allow."""
    near = np.flatnonzero(gains > gains.max() - _AT_95)
    return float(shapes[near[0]]), float(shapes[near[-1]])


def _with_amounts(effect: Effect, amounts: FloatArray) -> Effect:
    values = effect.values.copy()
    values[effect.amounts] = amounts
    return effect.with_values(values)
