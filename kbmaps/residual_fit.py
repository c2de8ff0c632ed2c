"""The most probable distorted chain: which distortions the pairs pay for, of what size, and how sure all of it is."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray
from kbmaps.block_choice import BLOCK_PAIRS, FEWEST_BLOCKS, MOST_BLOCKS
from kbmaps.chain import RigidChain
from kbmaps.chain_parameters import WIDE, ChainParameters
from kbmaps.pairs import Pairs
from kbmaps.residual_evidence import Average, GroupedModel, Moments
from kbmaps.residual_features import SMOOTH_GROUPS, ResidualFeatures

# Noise that is estimated is never below this [m]: there rounding begins.
_ROUNDING_M = 1e-9
# Of the chi distribution in three dimensions: 3 of 100,000 good pairs are further out; its median.
_OUTLIER_SIGMAS, _MEDIAN_NORM = 4.8, 1.538
_ROUNDS, _SELECTIONS = 6, 3
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
        model, design = self._model(self._considered() if select else tuple(self.variances))
        model.variances = dict(self.variances)
        if select:
            model.select(self._considered())
        else:
            model.settle()
        posterior = model.posterior()
        self.used = sum(posterior.used.values())
        step = posterior.mean - self._present(model.variances)
        moved = float(np.square(design[:, model.index()] @ step).sum()) / model.noise**2
        self.variances, self.noise = dict(model.variances), model.noise
        self._take(posterior.mean, tuple(model.variances))
        return math.sqrt(moved / max(self.used, 1.0))

    def average(self) -> Average:
        """The last step: to the mean over all probable sets of groups."""
        groups = self._considered()
        model, _ = self._model(groups)
        model.variances = dict(self.variances)
        average = model.average(() if self._on_path else groups)
        self._take(average.mean, average.groups)
        return average

    def _considered(self) -> tuple[str, ...]:
        """All groups; the largest only where the one before it is not enough."""
        known = self.variances
        return tuple(
            g for g in self._features.groups() if g != SMOOTH_GROUPS[2] or g in known or SMOOTH_GROUPS[1] in known
        )

    def _judge_pairs(self, residuals: FloatArray) -> None:
        """The middle residual tells what is typical, the noise of the last round what is meant to be."""
        norms = np.linalg.norm(residuals, axis=1) / self._pairs.unit
        typical = max(float(np.median(norms)) / _MEDIAN_NORM, self._least_noise)
        bound = typical if math.isinf(self.noise) else max(typical, self.noise)
        self.inliers = norms <= _OUTLIER_SIGMAS * bound
        if math.isinf(self.noise):
            self.noise = typical

    def _model(self, groups: Sequence[str]) -> tuple[GroupedModel, FloatArray]:
        """The linear model around the present weights, and its rows; the chain's weights are steps, others whole."""
        point = self._features.linearised(self.change, self.chain, self.weights, self._pairs.q, groups)
        self._judge_pairs(self._pairs.x - point.x)
        parts = {"": point.chain[:, :, self._free] * self.scales, **{g: point.groups[g] for g in groups}}
        target = self._pairs.x - point.x
        for group, weights in self.weights.items():
            target = target + point.groups[group] @ weights
        unit = self._pairs.unit[self.inliers]
        design = np.concatenate(list(parts.values()), axis=2)[self.inliers] / unit[:, None, None]
        rows, aims = design.reshape(-1, design.shape[2]), (target[self.inliers] / unit[:, None]).ravel()
        ends = np.cumsum([0, *(part.shape[2] for part in parts.values())])
        columns = {name: slice(int(a), int(b)) for name, a, b in zip(parts, ends[:-1], ends[1:], strict=True)}
        model = GroupedModel(
            Moments.of(rows, aims),
            columns,
            -self.change[self._free] / self.scales,
            least_noise=self._least_noise,
            noise=self.noise,
            blocks=self._blocks(rows, aims) if self._on_path else (),
        )
        return model, rows

    def _blocks(self, rows: FloatArray, aims: FloatArray) -> list[Moments]:
        count = min(max(len(rows) // (3 * BLOCK_PAIRS), FEWEST_BLOCKS), MOST_BLOCKS)
        runs = np.array_split(np.arange(len(rows)), count)
        return [Moments.of(rows[run], aims[run]) for run in runs]

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
