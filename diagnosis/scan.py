"""How much each hypothesis would explain of what a fit has left, to first order: moments and periods searched in full.

With what the fitted amounts can change projected out, a column c explains (c·r)² / (c·c) of the squared residuals r.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from effects import Effect
from interfaces.records import FloatArray

from .fit import LARGEST, Fit

# The finest ripple that is looked for.
_MOST_CYCLES = 100
# Widths of a play that are tried [rad, m], and time constants as shares of the recording's time.
_WIDTHS = np.geomspace(2e-4, 0.15, 14)
_TIME_CONSTANTS = np.array([0.03, 0.1, 0.3, 1.0, 3.0])
# Rows that have to lie on either side of a moment.
_BESIDE = 8
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
    """

    effect: Effect
    gain: float
    dof: int
    trials: int = 1


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
            if candidate is not None and candidate.dof > 0 and np.isfinite(candidate.gain):
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
                return self._shapes(effect, [np.array([0.0, 0.0, 0.0, c * span]) for c in _TIME_CONSTANTS])
            case _:
                return self._shapes(effect, [effect.values])

    def _shapes(self, effect: Effect, shapes: list[FloatArray], *, scaled: bool = False) -> Candidate | None:
        """The best of some shapes. `scaled`: the shape's own size is the amount, as a play's width."""
        best = None
        for values in shapes:
            shaped = effect.with_values(values)
            if scaled:
                place = self._fit.simulation.place(effect)
                assert effect.kind.encoder is not None
                bent = effect.kind.encoder.correction(self._fit.run.readings, place, values) / values[0]
                columns = self._port(place.joint)[:, :, None] * bent[:, None, None]
            else:
                columns = self._fit.weighted(self._fit.run.columns(shaped)[:, :, effect.amounts])
            gain, amounts, dof = self._explained(columns, shaped)
            if scaled:
                # The width that the shape was made with, and the one that it would take.
                off = abs(np.log(max(amounts[0], 1e-12) / values[0]))
                gain, amounts = (gain if off < np.log(3.0) else gain * 0.5), np.abs(amounts)
            if dof and (best is None or gain > best.gain):
                best = Candidate(_with_amounts(shaped, amounts), gain, dof, len(shapes))
        return best

    def _ripple(self, effect: Effect) -> Candidate | None:
        """Over all whole numbers of cycles a turn; of a slide, over periods down to twice its usual step."""
        place = self._fit.simulation.place(effect)
        q = self._fit.run.readings.q[:, place.joint]
        if place.prismatic:
            span = max(float(np.ptp(q)), 1e-6)
            cycles = np.arange(1, _MOST_CYCLES + 1) / span
            phases = 2.0 * np.pi * q[:, None] * cycles
        else:
            cycles = np.arange(2.0, _MOST_CYCLES + 1)
            phases = q[:, None] * cycles
        port = self._port(place.joint)
        onto = np.einsum("nir,ni->nr", self._basis, port)
        square, with_left = np.square(port).sum(axis=1), (port * self._left).sum(axis=1)
        pair = np.stack([np.sin(phases), np.cos(phases)], axis=2)  # (n, m, 2)
        inner = np.einsum("nma,n,nmb->mab", pair, square, pair, optimize=True)
        removed = np.einsum("nma,nr->mar", pair, onto, optimize=True)
        raw = np.einsum("maa->ma", inner).copy()
        inner -= removed @ np.swapaxes(removed, 1, 2)
        gradient = np.einsum("nma,n->ma", pair, with_left)
        gains, amounts, dofs = self._solved(inner, gradient, raw, effect)
        best = int(np.argmax(gains))
        values = np.array([*amounts[best], cycles[best]])
        return Candidate(effect.with_values(values), float(gains[best]), int(dofs[best]), len(cycles))

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
        row = best + _BESIDE
        moment = 0.5 * (clock[row - 1] + clock[row])
        values = np.append(amounts[best], moment)
        return Candidate(effect.with_values(values), float(gains[best]), int(dofs[best]), len(gains))

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
        """Gains (m,), amounts (m, k) and degrees of freedom (m,) of m systems (m, k, k) with what was left of raw (m, k)."""
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

    def _port(self, joint: int) -> FloatArray:
        """How the weighted residuals' prediction moves with one joint (n, 3)."""
        return self._ports[joint]

    @cached_property
    def _ports(self) -> FloatArray:
        return np.moveaxis(self._fit.weighted(self._fit.run.by_joint), 2, 0)


def _with_amounts(effect: Effect, amounts: FloatArray) -> Effect:
    values = effect.values.copy()
    values[effect.amounts] = amounts
    return effect.with_values(values)
