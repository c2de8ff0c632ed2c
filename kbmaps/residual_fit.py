"""The most probable distorted chain: which distortions the pairs pay for, of what size, and how sure all of it is."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray, IntArray
from kbmaps.block_choice import BLOCK_PAIRS, FEWEST_BLOCKS
from kbmaps.chain import RigidChain
from kbmaps.chain_parameters import WIDE, ChainParameters
from kbmaps.pairs import Pairs
from kbmaps.residual_evidence import Average, GroupedModel, Moments
from kbmaps.residual_features import SMOOTH_GROUPS, ResidualFeatures

# Noise that is estimated is never below this [m]: there rounding begins.
_ROUNDING_M = 1e-9
# Of the chi distribution in three dimensions: 3 of 100,000 good pairs are further out; its median.
_OUTLIER_SIGMAS, _MEDIAN_NORM = 4.8, 1.538
_ROUNDS, _SELECTIONS = 6, 2
# Few enough rows for a processor's cache.
_ROWS_AT_ONCE = 150
# Runs of pairs left out in turn on a path.
_BLOCKS = 8
# A step that moves the predictions by less than this share of what the weights leave open is the last.
_SMALL_STEP = 0.05
# Told noise explains a sum of squared residuals up to so many of its standard deviations (χ²) above its mean.
_MISFIT_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class ResidualFit:
    """A distorted chain and how sure it is.

    Attributes:
        change: the most probable parameters of the chain (size,).
        chain: the chain with them.
        weights: of the groups that the pairs speak for.
        scales: of the free parameters (f,): 1 in `spread` is so much.
        spread: W with the covariance W Wᵀ of the free parameters, then the weights.
        noise: estimated noise over unit; at least 1 where the units are the noise.
        freedom: residual coordinates minus those that all weights have used up.
        inliers: which pairs (n,) are no outliers.
    """

    change: FloatArray
    chain: RigidChain
    weights: dict[str, FloatArray]
    scales: FloatArray
    spread: FloatArray
    noise: float
    freedom: float
    inliers: BoolArray


class _Fitter:
    """One fit on its way: Gauss-Newton rounds around which groups and variances are found anew."""

    def __init__(
        self, features: ResidualFeatures, parameters: ChainParameters, std: FloatArray, pairs: Pairs, change: FloatArray
    ) -> None:
        self._features, self._parameters, self._pairs = features, parameters, pairs
        self._free = std > 0.0
        self.scales = np.minimum(std[self._free], WIDE)
        self._least_noise = 1.0 if pairs.known else _ROUNDING_M / float(pairs.unit.min())
        self._on_path = features.follow_a_path(pairs.q)
        self.change, self.chain = change.copy(), parameters.chain(change)
        self.weights: dict[str, FloatArray] = {}
        self.variances: dict[str, float] = {}
        self.noise, self.used = math.inf, 0.0
        self.inliers = np.ones(len(pairs), dtype=np.bool_)

    def step(self, select: bool) -> float:
        """To the most probable weights; how far that moves predictions, over what the weights leave open of them."""
        groups = self._considered() if select else tuple(self.variances)
        model = self._model(groups)
        model.variances = dict(self.variances)
        if select:
            model.select(groups)
        else:
            model.settle()
            model.prune()
        posterior = model.posterior()
        self.used = sum(posterior.used.values())
        step = posterior.mean - self._present(model.variances)
        moved = model.square_of(step) / model.noise**2
        self.variances, self.noise = dict(model.variances), model.noise
        self._take(posterior.mean, tuple(model.variances))
        return math.sqrt(moved / max(self.used, 1.0))

    def average(self) -> Average:
        """The last step: to the mean over all probable sets of groups."""
        groups = self._considered()
        model = self._model(groups)
        model.variances = dict(self.variances)
        average = model.average(() if self._on_path else groups)
        self._take(average.mean, average.groups)
        return average

    def _considered(self) -> tuple[str, ...]:
        """All groups with no more features than there are coordinates; the largest only where the one before is in."""
        coordinates = 3 * int(self.inliers.sum())
        largest, before = SMOOTH_GROUPS[2], SMOOTH_GROUPS[1]

        def asked(group: str) -> bool:
            if group in self.variances:
                return True
            return self._features.size(group) <= coordinates and (group != largest or before in self.variances)

        return tuple(group for group in self._features.groups() if asked(group))

    def _judge_pairs(self, residuals: FloatArray) -> None:
        """The middle residual tells what is typical, the noise of the last round what is meant to be."""
        norms = np.linalg.norm(residuals, axis=1) / self._pairs.unit
        typical = max(float(np.median(norms)) / _MEDIAN_NORM, self._least_noise)
        bound = typical if math.isinf(self.noise) else max(typical, self.noise)
        self.inliers = norms <= _OUTLIER_SIGMAS * bound
        if math.isinf(self.noise):
            self.noise = typical

    def _model(self, groups: Sequence[str]) -> GroupedModel:
        """The linear model around the present weights; the chain's weights are steps, the others' whole."""
        x = self._features.positions(self.chain, self.weights, self._pairs.q)
        self._judge_pairs(self._pairs.x - x)
        rows = np.flatnonzero(self.inliers)
        if self._on_path:
            parts = min(max(len(rows) // BLOCK_PAIRS, FEWEST_BLOCKS), _BLOCKS)
        else:
            parts = max(len(rows) // _ROWS_AT_ONCE, 1)
        sums = [self._moments(part, groups) for part in np.array_split(rows, parts)]
        sizes = [len(self.scales), *(self._features.size(group) for group in groups)]
        ends = np.cumsum([0, *sizes]).tolist()
        spans = itertools.starmap(slice, itertools.pairwise(ends))
        return GroupedModel(
            Moments.total(sums),
            dict(zip(("", *groups), spans, strict=True)),
            -self.change[self._free] / self.scales,
            least_noise=self._least_noise,
            noise=self.noise,
            blocks=sums if self._on_path else (),
        )

    def _moments(self, rows: IntArray, groups: Sequence[str]) -> Moments:
        """Of some pairs. What the groups explain at present is added to the target, for their weights are whole."""
        point = self._features.linearised(self.change, self.chain, self.weights, self._pairs.q[rows], groups)
        target = self._pairs.x[rows] - point.x
        for group, weights in self.weights.items():
            target += point.groups[group] @ weights
        unit = self._pairs.unit[rows, None]
        chain = point.chain[:, :, self._free] * self.scales
        design = np.concatenate([chain, *point.groups.values()], axis=2) / unit[:, :, None]
        return Moments.of(design.reshape(-1, design.shape[2]), (target / unit).ravel())

    def _present(self, groups: Iterable[str]) -> FloatArray:
        """Where the weights are before the step."""
        parts = [np.zeros(len(self.scales))]
        parts += [self.weights.get(g, np.zeros(self._features.size(g))) for g in groups]
        return np.concatenate(parts)

    def _take(self, mean: FloatArray, groups: Sequence[str]) -> None:
        self.change[self._free] += self.scales * mean[: len(self.scales)]
        self.chain = self._parameters.chain(self.change)
        start, self.weights = len(self.scales), {}
        for group in groups:
            self.weights[group] = mean[start : start + self._features.size(group)]
            start += self._features.size(group)


def fit_residual(
    features: ResidualFeatures, parameters: ChainParameters, std: FloatArray, pairs: Pairs, change: FloatArray
) -> ResidualFit | None:
    """The fit around the chain at `change`, the most probable rigid one; None if nothing speaks for more than that."""
    fitter = _Fitter(features, parameters, std, pairs, change)
    for turn in range(_ROUNDS):
        length = fitter.step(turn < _SELECTIONS)
        if not fitter.variances or (turn >= _SELECTIONS - 1 and length < _SMALL_STEP):
            break
    average = fitter.average()
    if not average.groups:
        return None
    freedom = max(3.0 * float(fitter.inliers.sum()) - fitter.used, 0.0)
    return ResidualFit(
        change=fitter.change,
        chain=fitter.chain,
        weights=fitter.weights,
        scales=fitter.scales,
        spread=average.spread,
        noise=_beyond_chance(fitter.noise, freedom) if pairs.known else fitter.noise,
        freedom=freedom,
        inliers=fitter.inliers,
    )


def _beyond_chance(noise: float, freedom: float) -> float:
    """Told noise, 1, unless the residuals are larger than what chance can make of it."""
    explained = freedom + _MISFIT_SIGMAS * math.sqrt(2.0 * freedom)
    return 1.0 if noise**2 * freedom <= explained else noise
