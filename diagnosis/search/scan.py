"""Scan all hypotheses against the residuals of a fit, to first order, with full search over moments and periods.

With the directions of the fitted amounts projected out, a column c explains (c·r)² / (c·c) of the squared residuals r.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from bodyschema.diagnosis.fit.fit import Fit, FitSettings
from bodyschema.diagnosis.fit.net_evidence import choice_count, choice_counts, evidence_gain
from bodyschema.diagnosis.fit.products import Products, System
from bodyschema.diagnosis.fit.tangent import TangentSettings
from bodyschema.effects import Effect, Identity
from bodyschema.effects.encoder import EncoderEffect
from bodyschema.effects.motion import flanks
from bodyschema.interfaces.records import FloatArray


class ScanSettings:
    """Settings of the scan.

    Sensitivity, each at 0.3 and 3 times over three recordings with hidden errors: `most_moments` and `beside` change
    what is rejected; the others change nothing.
    """

    between = 2.5  # largest loss factor halfway between two shapes tried: for waves, one over sinc² of a half
    coarse = 5  # effective number of independent shapes of a smooth family
    max_moments = 1000  # number of moments tried first, before all those next to the best
    beside = 8  # minimum of rows on either side of a moment
    bent = 0.1  # share of the noise by which an effect has to differ from its first order to be evaluated beyond it
    # Ripples are searched at every whole number of cycles per turn up to the first limit. Finer ones, up to twice per
    # turn of a strain wave gear of 120, are searched as coarsely as they can be resolved.
    max_cycles, finest_cycles = 100, 240


# Index of the best choice, gains (m,), its amounts (k,) and degrees of freedom.
_Tried = tuple[int, FloatArray, FloatArray, int]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis with its best first-order fit."""

    effect: Effect  # with the amounts of the linear fit, and the moment or period found
    gain: float  # Δχ²
    dof: int  # number of its amounts that the data determine
    trials: float = 1  # number of moments, periods or choices of its numbers tried
    interval: tuple[float, float] | None = None  # 95 % interval of the moment; None for an effect that has none


class Scan:
    """First-order tests of all hypotheses against one fit, complete or without one of its causes.

    Args:
        left_out: causes to leave out one at a time; these scans share most of the work.
    """

    def __init__(self, fit: Fit, left_out: Sequence[Effect] = ()) -> None:
        self._fit, self._products, self._state = fit, Products(fit, left_out), 0
        self._left_out_causes = tuple(cause.identity for cause in left_out)
        self._before = {0: fit.run.measured}

    def without(self, cause: Effect) -> Scan:
        """Return the scan of the fit without one of `left_out`, all others refitted to first order."""
        scan = copy(self)
        scan._state = 1 + self._left_out_causes.index(cause.identity)
        return scan

    def is_within_tolerance(self, effect: Effect) -> bool:
        """Return True if the fit's background already contains such errors."""
        return self._fit.background.is_within_tolerance(effect)

    def candidates(self, hypotheses: Iterable[Effect], near: float = 0.0) -> list[Candidate]:
        """Return a candidate for each hypothesis that the data can test.

        Args:
            near: share of the best gain below which periods and time constants are not refined.
        """
        found, most = [], 0.0
        for effect in sorted(hypotheses, key=lambda effect: len(effect.shapes)):
            candidate = self.candidate(effect, near * most)
            if candidate is not None and candidate.effect.is_valid and np.isfinite(candidate.gain):
                found.append(candidate)
                most = max(most, candidate.gain)
        return found

    def candidate(self, effect: Effect, least: float = 0.0) -> Candidate | None:
        """Return the hypothesis with its best first-order fit; None if no part of it is identifiable.

        Args:
            least: gain from which its period or time constant is refined fully.
        """
        match effect.kind.search:
            case "cycles":
                return self._ripple(effect, least)
            case "moment":
                return self._moment(effect)
            case "width":
                return self._backlash(effect)
            case "shape":
                return self._shape_search(effect, effect.kind.trial_shapes(self._fit.observations.motion), least)
            case "load":
                return self._loaded_backlash(effect)
            case _ if effect.kind.in_parts and effect.free is None:
                return self._in_parts(effect)
            case _:
                gains, amounts, dofs = self._solved(self._linear(effect), effect)
                if not dofs[0]:
                    return None
                return Candidate(effect.with_amounts(amounts[0]), float(gains[0]), int(dofs[0]), choice_count(effect))

    def _in_parts(self, effect: Effect) -> Candidate | None:
        """Return an effect with the subset of its amounts free that is worth its cost; None if none is identifiable."""
        inner, gradient, raw = self._linear(effect).at(self._state)
        chosen = _subsets(inner.shape[1])
        # Amounts that are not free keep no product with the residuals or with the others.
        both = chosen[:, :, None] & chosen[:, None, :]
        inners, gradients = np.where(both, inner, 0.0), np.where(chosen, gradient, 0.0)
        gains, amounts = self._gains(inners, gradients, effect)
        dofs = self._dofs(inners, np.broadcast_to(raw, chosen.shape), effect)
        ways = choice_counts(effect)[(chosen << np.array(effect.amounts)).sum(axis=1)]
        net_evidences = [
            evidence_gain(float(gain), int(dof)) - np.log(way) if dof == size else -np.inf
            for gain, dof, size, way in zip(gains, dofs, chosen.sum(axis=1), ways, strict=True)
        ]
        best = int(np.argmax(net_evidences))
        if not np.isfinite(net_evidences[best]):
            return None
        freed = effect.with_free_amounts(tuple(np.array(effect.amounts)[chosen[best]].tolist()))
        found = freed.with_amounts(amounts[best][chosen[best]])
        return Candidate(found, float(gains[best]), int(dofs[best]), choice_count(found))

    def beyond_first_order(self, candidate: Candidate) -> Candidate:
        """Return the candidate with the gain at its actual amounts, if that exceeds the first-order gain.

        A rotation by some degrees is not linear compared with noise of a tenth of a millimetre.
        """
        if not self._is_nonlinear(candidate.effect):
            return candidate
        effects = [effect for effect in self._fit.simulation.effects if effect.identity != self._left_out]
        simulation, motion = self._fit.simulation, self._fit.observations.motion
        if self._state not in self._before:
            self._before[self._state] = simulation.with_effects(effects).run(motion).measured
        before = self._before[self._state]
        after = simulation.with_effects([*effects, candidate.effect]).run(motion).measured
        inner, rhs, _ = self._products.of(self._fit.weighted((after - before)[:, :, None])).at(self._state)
        square = self._products.squares[self._state]
        explained = np.clip(rhs[0, 0] ** 2 / max(float(inner[0, 0, 0]), 1e-300), 0.0, 0.999999 * square)
        gain = float(-3.0 * self._products.rows * np.log1p(-explained / square))
        return replace(candidate, gain=gain) if gain > candidate.gain else candidate

    def _is_nonlinear(self, effect: Effect) -> bool:
        """Return True if an effect deviates from its first order by more than the noise.

        A move by d along an arc of radius r leaves its tangent by d²/2r.
        """
        run, observations = self._fit.run, self._fit.observations
        moved = run.columns(effect)[:, :, effect.amounts] @ effect.values[effect.amounts]
        radius = float(np.sqrt(np.square(run.x_true - run.frames[:, 0, :3, 3]).sum(axis=1).mean()))
        off = np.square(moved).sum(axis=1, keepdims=True) / (2.0 * max(radius, 1e-6))
        # In all directions, since the direction is unknown.
        white = observations.whitened(np.broadcast_to(off[:, :, None] * np.eye(3), (len(off), 3, 3)))
        return bool(np.square(white).sum(axis=(1, 2)).mean() > 3.0 * (ScanSettings.bent * self._fit.noise.sigma) ** 2)

    @property
    def _left_out(self) -> Identity | None:
        return self._left_out_causes[self._state - 1] if self._state else None

    def _shape_search(self, effect: Effect, shapes: FloatArray, least: float) -> Candidate | None:
        """Return the best fit of an effect with one shape parameter, at increasing shapes (m,), then between them."""
        # Each place without a cause uses the same coarse shapes.
        gains, amounts, dofs = self._solved(
            self._products.cached(effect, lambda: self._shape_systems(effect, shapes)), effect
        )
        if not dofs.any():
            return None
        identifiable, best = shapes[dofs > 0], int(np.argmax(np.where(dofs > 0, gains, -np.inf)))
        if self._gain_of_squares(float(gains[best]), ScanSettings.between) >= least:
            place = int(np.searchsorted(identifiable, shapes[best]))
            shapes = np.linspace(
                identifiable[max(place - 1, 0)], identifiable[min(place + 1, len(identifiable) - 1)], 13
            )
            gains, amounts, dofs = self._solved(self._shape_systems(effect, shapes), effect)
            best = int(np.argmax(gains))
        values = np.append(amounts[best], shapes[best])
        trials = ScanSettings.coarse * effect.kind.further_trials
        return Candidate(effect.with_values(values), float(gains[best]), int(dofs[best]), trials)

    def _shape_systems(self, effect: Effect, shapes: FloatArray) -> System:
        """Return the system of each shape (m,), which scales the same columns row by row."""
        run = self._fit.run
        if not isinstance(effect.kind, EncoderEffect):
            constant = np.broadcast_to(np.eye(3), (len(run.motion), 3, 3))
            rows = self._products.rows_of(self._fit.weighted(constant))
            factors = [effect.kind.growth(run.motion, float(shape)) for shape in shapes]
        else:
            place, encoder = self._fit.simulation.place(effect), effect.kind
            rows = self._products.joint_rows(place.joint)
            shaped = (np.append(effect.values[:-1], shape) for shape in shapes)
            factors = [encoder.columns(run.readings, place, values)[:, 0] for values in shaped]
        return rows.scaled(np.stack(factors, axis=1))

    def _backlash(self, effect: Effect) -> Candidate | None:
        """Return the best backlash over widths; the amount is the width itself."""
        place, encoder = self._fit.simulation.place(effect), effect.kind
        assert isinstance(encoder, EncoderEffect)
        widths = encoder.trial_shapes(self._fit.observations.motion)

        def bent() -> System:
            by_width = [encoder.correction(self._fit.run.readings, place, np.array([w])) / w for w in widths]
            return self._products.joint_rows(place.joint).scaled(np.stack(by_width, axis=1))

        gains, amounts, dofs = self._solved(self._products.cached(effect, bent), effect)
        # Compare the width used to build the shape with the fitted one.
        off = np.abs(np.log(np.maximum(amounts[:, 0], 1e-12) / widths))
        gains = np.where(dofs > 0, np.where(off < np.log(3.0), gains, 0.5 * gains), -np.inf)
        best = int(np.argmax(gains))
        if not dofs[best]:
            return None
        return Candidate(effect.with_values(amounts[best]), float(gains[best]), int(dofs[best]), len(widths))

    def _loaded_backlash(self, effect: Effect) -> Candidate | None:
        """Return the best loaded backlash over frictions; None if the load never changes sides."""
        run = self._fit.run
        k = self._fit.simulation.place(effect).joint
        torque = run.torques[:, k]
        holds = np.abs(torque).max() * effect.kind.trial_shapes(run.motion)
        sides = np.stack([flanks(torque, hold) for hold in holds], axis=1)
        changing = np.ptp(sides, axis=0) > 0.0
        if not changing.any() or not run.simulation.bears_weight:
            return None
        holds, sides = holds[changing], sides[:, changing]
        best, gains, amounts, dof = self._best(self._products.joint_rows(k).scaled(0.5 * sides), effect)
        if not dof:
            return None
        values = np.append(amounts, holds[best])
        return Candidate(effect.with_values(values), float(gains[best]), dof, len(holds))

    def _ripple(self, effect: Effect, least: float) -> Candidate | None:
        """Return the best ripple over whole cycles per turn, then near the best; prismatic joints use their path."""
        place = self._fit.simulation.place(effect)
        span = max(float(np.ptp(self._fit.run.readings.q[:, place.joint])), 1e-6)
        first, step = (2.0, 1.0) if not place.prismatic else (1.0 / span, 1.0 / span)
        coarse: FloatArray = np.asarray(first + step * np.arange(ScanSettings.max_cycles - 1), dtype=np.float64)
        # The width of a peak is the change that shifts the phase by one turn over the range.
        width = 1.0 / span if place.prismatic else 2.0 * np.pi / span
        bands = [coarse]
        if not place.prismatic:
            apart = max(min(width, 0.1 * (ScanSettings.finest_cycles - ScanSettings.max_cycles)), step)
            bands.append(np.arange(ScanSettings.max_cycles + 1.0, ScanSettings.finest_cycles, apart))
        tried, cycles = max(((self._best_ripple(effect, band), band) for band in bands), key=_best_gain)
        if width < step or self._gain_of_squares(float(tried[1][tried[0]]), ScanSettings.between) >= least:
            fine: FloatArray = cycles[tried[0]] + 0.5 * max(width, step) * np.linspace(-1.0, 1.0, 61)
            cycles = np.asarray(fine[fine > 0.5 * first], dtype=np.float64)
            tried = self._best(self._ripple_system(effect, cycles), effect)
        best, gains, amounts, dof = tried
        if not dof:
            return None
        values = np.array([*amounts, cycles[best]])
        return Candidate(effect.with_values(values), float(gains[best]), dof, 2 * sum(map(len, bands)))

    def _gain_of_squares(self, gain: float, factor: float) -> float:
        """Return the gain that corresponds to explaining `factor` times the squares."""
        share = -np.expm1(-gain / (3.0 * self._products.rows))
        return float(-3.0 * self._products.rows * np.log1p(-min(factor * share, 0.999999)))

    def _best_ripple(self, effect: Effect, cycles: FloatArray) -> _Tried:
        """Return the best of a band of cycles, which is tried in place of each cause."""
        begun = effect.with_values(np.append(effect.values[:-1], cycles[0]))
        return self._best(self._products.cached(begun, lambda: self._ripple_system(effect, cycles)), effect)

    def _ripple_system(self, effect: Effect, cycles: FloatArray) -> System:
        """Return the system of equally spaced numbers of cycles (m,)."""
        place = self._fit.simulation.place(effect)
        angle = self._fit.run.readings.q[:, place.joint] * (2.0 * np.pi if place.prismatic else 1.0)
        # Compute exp(i cycles angle), each from the one before.
        waves = np.empty((len(angle), len(cycles)), dtype=np.complex128)
        waves[:, 0] = np.exp(1j * cycles[0] * angle)
        waves[:, 1:] = np.exp(1j * (cycles[1] - cycles[0]) * angle)[:, None]
        np.multiply.accumulate(waves, axis=1, out=waves)
        return self._products.joint_rows(place.joint).modulated(waves)

    def _moment(self, effect: Effect) -> Candidate | None:
        """Return the best moment between two rows: a coarse search, then all near the best."""
        n = len(self._fit.weighted_residuals)
        if n < 2 * ScanSettings.beside + 1:
            return None
        begun = effect.with_values(np.append(effect.values[:-1], -np.inf))

        def step_systems(rows: range) -> System:
            columns = self._fit.weighted(self._fit.run.columns(begun)[:, :, effect.amounts])
            return self._products.step_systems(columns, rows)

        step = 1 + n // ScanSettings.max_moments
        some = range(ScanSettings.beside, n - ScanSettings.beside, step)
        best, gains, amounts, dof = self._best(self._products.cached(effect, lambda: step_systems(some)), effect)
        if not dof:
            return None
        tried, row = np.asarray(some), some[best]
        if step > 1:
            beside = range(max(row - step + 1, ScanSettings.beside), min(row + step, n - ScanSettings.beside))
            best, closer, amounts, dof = self._best(step_systems(beside), effect)
            row = beside[best]
            tried, first = np.unique(np.append(tried, beside), return_index=True)
            gains = np.append(gains, closer)[first]
        clock = self._fit.observations.motion.clock
        values = np.append(amounts, 0.5 * (clock[row - 1] + clock[row]))
        shapes = 0.5 * (clock[tried - 1] + clock[tried])
        near = np.flatnonzero(gains > gains.max() - float(chdtri(1, 0.05)))
        interval = float(shapes[near[0]]), float(shapes[near[-1]])
        return Candidate(effect.with_values(values), float(gains.max()), dof, n - 2 * ScanSettings.beside, interval)

    def _linear(self, effect: Effect) -> System:
        """Return the system of an effect that has amounts only."""

        def linear() -> System:
            encoder = effect.kind
            if not isinstance(encoder, EncoderEffect):
                return self._products.of(self._fit.weighted(self._fit.run.columns(effect)[:, :, effect.amounts]))
            place = self._fit.simulation.place(effect)
            factors = encoder.columns(self._fit.run.readings, place, effect.values)[:, effect.amounts]
            return self._products.joint_rows(place.joint).mixed(factors)

        return self._products.cached(effect, linear)

    def present_gain(self, effect: Effect) -> float:
        """Return the `Candidate.gain` of an effect with its present moment, period or width."""
        columns = self._fit.weighted(self._fit.run.columns(effect)[:, :, effect.amounts])
        return float(self._solved(self._products.of(columns), effect)[0][0])

    def _solved(self, system: System, effect: Effect) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return gains (m,), amounts (m, k) and degrees of freedom (m,) of m systems."""
        inner, gradient, raw = system.at(self._state)
        gains, amounts = self._gains(inner, gradient, effect)
        dofs = self._dofs(inner, raw, effect)
        return np.where(dofs > 0, gains, 0.0), amounts, dofs

    def _best(self, system: System, effect: Effect) -> _Tried:
        """Return the index of the best of many systems, gains (m,), its amounts (k,) and degrees of freedom."""
        inner, gradient, raw = system.at(self._state)
        gains, amounts = self._gains(inner, gradient, effect)
        best = int(np.argmax(gains))
        # Other systems need checking only if the best is not identifiable.
        if not (dof := int(self._dofs(inner[[best]], raw[[best]], effect)[0])):
            dofs = self._dofs(inner, raw, effect)
            gains = np.where(dofs > 0, gains, 0.0)
            best = int(np.argmax(gains))
            dof = int(dofs[best])
        return best, gains, amounts[best], dof

    def _gains(self, inner: FloatArray, gradient: FloatArray, effect: Effect) -> tuple[FloatArray, FloatArray]:
        """Return gains (m,) and amounts (m, k)."""
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
        """Return degrees of freedom (m,)."""
        unit = _units(effect)
        shares = _eigenvalues(inner / np.sqrt(np.maximum(raw[:, :, None] * raw[:, None, :], 1e-300)))
        identifiable = _eigenvalues(inner * unit[:, None] * unit) > 10.0 * self._fit.noise.sigma**2
        return ((shares > TangentSettings.told_apart) & identifiable).sum(axis=1)


def refit_moment(fit: Fit, cause: Effect, rows: NDArray[np.bool_]) -> Candidate | None:
    """Return a cause that begins at a moment with its best moment.

    Args:
        rows: rows (n,) that count fully, since those on the wrong side of the moment look like outliers.
    """
    weights = np.where(rows & fit.observations.trusted, 1.0, fit.noise.weights)
    counted = replace(fit, noise=replace(fit.noise, weights=weights))
    return Scan(counted, [cause]).without(cause).candidate(cause)


@cache
def _subsets(count: int) -> NDArray[np.bool_]:
    """Return all subsets of `count` amounts (m, count)."""
    chosen = (np.arange(1, 2**count)[:, None] >> np.arange(count)) & 1
    return np.asarray(chosen, dtype=np.bool_)


def _units(effect: Effect) -> FloatArray:
    """Return the largest expected size of each of an effect's amounts (k,)."""
    return FitSettings.largest * np.array([effect.parameters[j].usual for j in effect.amounts])


def _eigenvalues(matrices: FloatArray) -> FloatArray:
    """Return the eigenvalues (m, k) of symmetric matrices (m, k, k), in increasing order."""
    values = matrices[:, 0] if matrices.shape[1] == 1 else np.linalg.eigvalsh(matrices)
    return np.asarray(values, dtype=np.float64)


def _best_gain(tried: tuple[_Tried, FloatArray]) -> float:
    (best, gains, _, _), _ = tried
    return float(gains[best])
