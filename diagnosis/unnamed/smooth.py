"""Fit a smooth model of the unnamed errors, and store the part that depends on readings alone.

It fits the functions of the families found, together with the parameters of the causes. Functions of the readings
become a KB-Map; changes with time cannot be stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np

from bodyschema.diagnosis.fit.fit import Fit, solved
from bodyschema.diagnosis.search.held_out import Blocks
from bodyschema.effects import Motion, PipelineRun, Unexplained, place_map, smooth_map
from bodyschema.interfaces.records import FloatArray

from .families import DiscrepancyFamily
from .family_fits import FitWithDiscrepancy


class _Settings:
    """Settings of the smooth model.

    Sensitivity, each at 0.3 and 3 times in a recording with a smooth unnamed error: one round, or `worse` below 1,
    changes the gain by 0.4 % and figures of rejected causes; `wide` and more rounds 1 % at most.
    """

    # Prior sizes of a function's displacement, in units of the noise; held-out rows choose among them.
    sizes = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
    wide = 400  # postures over which functions are scaled
    # Rounds for the curvature of erring joints, which end when held-out errors grow by more than this factor.
    rounds, worse = 3, 1.05
    left_out, too_far_off = 0.02, 0.5  # tolerance of a stored model, and its largest error, in units of the noise
    harmonics = (14, 4)  # harmonics of one joint's angle, and of each of two joints' angles


@dataclass(frozen=True, eq=False)
class SmoothModel:
    """Smooth functions of families, fitted to the residuals of the causes."""

    fit: Fit  # the causes beside the stored part, which is in its simulation
    stored: Unexplained | None  # the learnt model; None where everything changes with time or no lasting part remains
    explained: FloatArray  # prediction of the functions at the rows (n, 3) [m]
    unstored: FloatArray  # the time-dependent part of it, which is not in the fit's simulation
    # change of each row's prediction by the stored simulation due to that row being fitted (n, 3) [m]
    in_sample_change: FloatArray


def smooth_model(
    alone: Fit, discrepancy_fit: FitWithDiscrepancy, families: Sequence[DiscrepancyFamily], blocks: Blocks
) -> SmoothModel:
    """Learn the families' functions beside the causes of a fit.

    Args:
        discrepancy_fit: the same causes beside the families.
    """
    predicted_change = discrepancy_fit.predicted - alone.predicted
    static = [family for family in families if not family.over_time]
    # All families of image position share the same functions, so one stands for all.
    places = [family for family in static if family.kind == "place"]
    static = [family for family in static if family.kind != "place"] + places[:1]
    timed = [family for family in families if family.over_time]
    # Try the causes as fitted alone and as fitted beside the families.
    starts = [
        replace(fit, noise=discrepancy_fit.fit.noise) for fit in (alone, alone.at(discrepancy_fit.fit.simulation))
    ]
    learnt = [_fit_functions(fit, static, timed, blocks) for fit in starts]
    fit, functions, amounts = min(learnt, key=lambda one: one[2].static_squares)
    causes = _Amounts(starts[0], functions.columns[:, :, :0], _timed(fit, ()), blocks)
    none = SmoothModel(starts[0], None, predicted_change, predicted_change, causes.in_sample_change)
    if not static or amounts.static_squares > causes.static_squares:
        return none
    noise_m = _noise_m(fit)
    stored, off_m = functions.stored(amounts.function_amounts, _Settings.left_out * noise_m)
    if off_m > _Settings.too_far_off * noise_m:
        return none
    beside = fit.to(fit.observations, replace(fit.simulation, residual=stored))
    later = _Amounts(beside, functions.columns[:, :, :0], _timed(beside, timed), blocks)
    explained = functions.shift(functions.given, amounts.function_amounts) + later.in_time
    return SmoothModel(beside, stored, explained, later.in_time, amounts.in_sample_change)


def _fit_functions(
    fit: Fit, static: Sequence[DiscrepancyFamily], timed: Sequence[DiscrepancyFamily], blocks: Blocks
) -> tuple[Fit, _Functions, _Amounts]:
    """Fit the amounts of all functions, following the curvature of erring joints while held-out errors allow it."""
    functions = _Functions(fit, static)
    amounts = _Amounts(fit, functions.columns, _timed(fit, timed), blocks)
    for _ in range(_Settings.rounds if any(family.kind == "joint" for family in static) else 0):
        nonlinear = functions.nonlinear(amounts.function_amounts)
        further = _Amounts(fit, functions.columns, _timed(fit, timed), blocks, nonlinear)
        if further.static_squares > _Settings.worse * amounts.static_squares:
            break
        amounts = further
    return fit, functions, amounts


def _noise_m(fit: Fit) -> float:
    """Return the RMS length of the noise [m]."""
    roots = np.linalg.inv(fit.observations.whitening)
    return fit.noise.sigma * float(np.sqrt(np.square(roots).sum(axis=(1, 2)).mean()))


def _timed(fit: Fit, families: Sequence[DiscrepancyFamily]) -> FloatArray:
    """Return the columns (n, 3, p) of time-dependent families, each with an RMS of one."""
    columns = _joined_columns([family.columns(fit.run) for family in families], len(fit.residuals))
    return columns / np.maximum(np.sqrt(3.0 * np.square(columns).mean(axis=(0, 1))), 1e-300)


def _joined_columns(columns: Sequence[FloatArray], rows: int) -> FloatArray:
    return np.concatenate([np.empty((rows, 3, 0)), *columns], axis=2)


class _Functions:
    """Functions of the readings of some families, each scaled to move the marker by 1 m (RMS) over all postures.

    They are computed along the rigid chain with the effects that it can hold, so they depend on the readings alone.
    """

    def __init__(self, fit: Fit, families: Sequence[DiscrepancyFamily]) -> None:
        self._simulation, self.given = fit.simulation, fit.observations.motion.q
        # A prismatic joint's functions cover the range of its readings.
        ends = [f(self.given[:, k]) for k in range(self.given.shape[1]) for f in (np.argmin, np.argmax)]
        self._ends = self.given[ends]
        self._robot = fit.simulation.robot
        self._x = self._robot.chain.positions(self.given)
        self._centre, self._spread = self._x.mean(axis=0), self._x.std(axis=0) + 1e-9
        self._families = families
        wide = self._at(self._wide_postures())
        self._scales = np.maximum(np.sqrt(3.0 * np.square(wide).mean(axis=(0, 1))), 1e-12)

    @cached_property
    def columns(self) -> FloatArray:
        """Functions at the rows of the fit (n, 3, p)."""
        return self._at(self.given) / self._scales

    def stored(self, amounts: FloatArray, tolerance_m: float) -> tuple[Unexplained, float]:
        """Build a model of the functions times amounts (p,) plus what the simulation already has.

        Returns:
            The model, and its RMS error at the rows of the fit [m].
        """
        before, shares = self._simulation.residual, amounts / self._scales

        def wanted(q: FloatArray) -> FloatArray:
            new = self.shift(q, amounts)
            return new if before is None else new + before.predict(q)

        if before is None and all(family.kind == "place" for family in self._families):
            model = place_map(self._robot, lambda x: self._place_functions(x) @ shares, self._x, tolerance_m)
            return model, 0.0
        model = smooth_map(self._robot, wanted, self.given, tolerance_m)
        off = model.predict(self.given) - wanted(self.given)
        return model, float(np.sqrt(np.square(off).sum(axis=1).mean()))

    def shift(self, q: FloatArray, amounts: FloatArray) -> FloatArray:
        """Return the displacement (n, 3) [m] at readings (n, d) by amounts (p,), rotating erring joints exactly."""
        run = self._run(q)
        shares, errors = amounts / self._scales, np.zeros_like(run.motion.q)
        shift, first = np.zeros((len(errors), 3)), 0
        for family in self._families:
            columns = self._columns(family, run)
            own = shares[first : first + columns.shape[2]]
            first += len(own)
            if family.kind == "joint" and family.joint is not None:
                errors[:, family.joint] += self._turns(family, run) @ own
            else:
                shift += columns @ own
        if errors.any():
            shift += run.simulation.positions(Motion.still(run.motion.q + errors)) - run.measured
        return shift[len(self._ends) :]

    def nonlinear(self, amounts: FloatArray) -> FloatArray:
        """Return the nonlinear part (n, 3) [m] of the displacement by erring joints at the rows of the fit."""
        return self.shift(self.given, amounts) - self.columns @ amounts

    def _run(self, q: FloatArray) -> PipelineRun:
        return self._simulation.rigid.run(Motion.still(np.concatenate([self._ends, q])))

    def _at(self, q: FloatArray) -> FloatArray:
        run = self._run(q)
        return _joined_columns([self._columns(family, run) for family in self._families], len(run.q))[len(self._ends) :]

    def _columns(self, family: DiscrepancyFamily, run: PipelineRun) -> FloatArray:
        if family.kind == "place":
            return self._place_functions(self._robot.chain.positions(run.motion.q))
        if family.kind == "joint":
            return family.moves(run) * self._turns(family, run)[:, None, :]
        return family.columns(run)

    def _turns(self, family: DiscrepancyFamily, run: PipelineRun) -> FloatArray:
        """Return the functions (n, p) of a joint's error: periodic, and finer than those that detect its family."""
        if not family.drivers:
            return family.amounts(run)
        first, *others = (self._periodic(run, k, _Settings.harmonics[len(family.drivers) - 1]) for k in family.drivers)
        for other in others:
            first = (first[:, :, None] * other[:, None, :]).reshape(len(first), -1)
        return first

    def _periodic(self, run: PipelineRun, joint: int, count: int) -> FloatArray:
        """Return harmonics of a joint's reading (n, 2 count + 1); a prismatic joint's range counts as half a turn."""
        low, high = self.given[:, joint].min(), self.given[:, joint].max()
        scale = np.pi / (high - low) if self._robot.chain.prismatic[joint] else 1.0
        angles = scale * run.motion.q[:, [joint]] * np.arange(count + 1)
        return np.concatenate([np.cos(angles), np.sin(angles[:, 1:])], axis=1)

    def _place_functions(self, x: FloatArray) -> FloatArray:
        """Return cubic functions (n, 3, 60) of the marker's position; those of its rays cannot be stored (poles)."""
        place = (x - self._centre) / self._spread
        products = [np.ones((len(x), 1)), place]
        for degree in (2, 3):
            chosen = combinations_with_replacement(range(3), degree)
            products += [place[:, indices].prod(axis=1, keepdims=True) for indices in map(list, chosen)]
        amounts = np.concatenate(products, axis=1)
        return (np.eye(3)[:, :, None] * amounts[:, None, None, :]).reshape(len(x), 3, -1)

    def _wide_postures(self) -> FloatArray:
        """Return postures over the joints' range; for prismatic joints, over that of the recording."""
        robot, q = self._robot, self.given
        slides = robot.chain.prismatic
        low = np.where(slides, q.min(axis=0), np.maximum(robot.lower, -np.pi))
        high = np.where(slides, q.max(axis=0), np.minimum(robot.upper, np.pi))
        return low + (high - low) * np.random.default_rng(0).uniform(size=(_Settings.wide, q.shape[1]))


class _Amounts:
    """Amounts of each function, with the causes' parameters free beside them."""

    def __init__(
        self, fit: Fit, functions: FloatArray, timed: FloatArray, blocks: Blocks, nonlinear: FloatArray | None = None
    ) -> None:
        self._fit, self._blocks = fit, blocks
        self._left_m = fit.observations.x - fit.predicted - (0.0 if nonlinear is None else nonlinear)
        self._causes, self._lasting = len(fit.precision), functions.shape[2]
        self._columns = np.concatenate([fit.derivatives, functions, timed], axis=2)
        flat = fit.weighted(self._columns).reshape(fit.weighted_residuals.size, -1)
        left = fit.weighted(self._left_m[:, :, None]).ravel()
        self._folds, self._products = np.unique(blocks.fold), []
        for fold in self._folds:
            rows = np.repeat(blocks.fold == fold, 3)
            own = flat[rows]
            self._products.append((own.T @ own, own.T @ left[rows], float(left[rows] @ left[rows])))
        self._inner = np.sum([inner for inner, _, _ in self._products], axis=0)
        self._rhs = np.sum([rhs for _, rhs, _ in self._products], axis=0)
        tried = [(self._missed(size), size) for size in _Settings.sizes]
        self._size = min(tried)[1]
        self._all = self._solved(self._size)

    @property
    def function_amounts(self) -> FloatArray:
        """Amounts of the time-independent functions (p,)."""
        return self._all[self._causes :][: self._lasting]

    @property
    def in_time(self) -> FloatArray:
        """Time-dependent prediction (n, 3) [m], with the accompanying change of the causes' parameters."""
        static = slice(self._causes, self._causes + self._lasting)
        return self._columns @ self._all - self._columns[:, :, static] @ self._all[static]

    @property
    def static_squares(self) -> float:
        """Held-out sum of squares, whitened, left by causes and lasting functions."""
        left = self._fit.weighted((self._left_m - self.predicted_change + self.in_sample_change)[:, :, None])
        return float(np.square(left).sum())

    @property
    def predicted_change(self) -> FloatArray:
        """Change of the prediction (n, 3) [m] by causes and lasting functions."""
        static = slice(0, self._causes + self._lasting)
        return self._columns[:, :, static] @ self._all[static]

    @cached_property
    def in_sample_change(self) -> FloatArray:
        """Change of each row's prediction (n, 3) [m] due to that row being in the fit."""
        more = np.zeros_like(self._fit.residuals)
        static = slice(0, self._causes + self._lasting)
        for k, fold in enumerate(self._folds):
            rows = self._blocks.fold == fold
            change = self._all - self._solved(self._size, without=k)
            more[rows] = self._columns[rows][:, :, static] @ change[static]
        return more

    def _missed(self, size: float) -> float:
        total = 0.0
        for k, (inner, rhs, square) in enumerate(self._products):
            amounts = self._solved(size, without=k)
            total += square + float(amounts @ inner @ amounts - 2.0 * amounts @ rhs)
        return total

    def _solved(self, size: float, without: int | None = None) -> FloatArray:
        """Return all amounts under a prior of this size, from all rows or without those of one fold."""
        free = len(self._rhs) - self._causes
        precision = [self._fit.precision]
        precision.append(np.full(free, (size * _noise_m(self._fit)) ** -2))
        ridge = np.diag(np.concatenate(precision)) * self._fit.noise.sigma**2
        if without is None:
            return solved(self._inner + ridge, self._rhs)
        inner, rhs, _ = self._products[without]
        return solved(self._inner - inner + ridge, self._rhs - rhs)
