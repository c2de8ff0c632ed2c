"""Most probable distorted chain: selection of distortions by evidence, their sizes, and the uncertainty."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray, IntArray
from kbmaps.chains.belief import squared
from kbmaps.maps.block_choice import BlockSettings
from kbmaps.pairs import Pairs
from kbmaps.residual.evidence import Average, GroupedModel, GroupSettings, Moments
from kbmaps.residual.features import SMOOTH_GROUPS
from kbmaps.residual.model import ResidualModel
from kbmaps.robust import MEDIAN_NORM, RobustSettings


class _Settings:
    """Settings of the fit of the residual.

    Sensitivity: each at 0.3 and 3 times changes error and sigma of a bent arm's models at 150 pairs by less than 1 %.
    """

    # Candidate correlations of neighbours' errors.
    correlations: tuple[float, ...] = (0.0, 0.2, 0.4, 0.55, 0.65, 0.75, 0.8, 0.85, 0.88, 0.91, 0.94, 0.97)
    rounds: int = 6
    selections: int = 2
    rows_at_once: int = 150  # few enough rows for a processor's cache
    # With fewer coordinates of pairs on a path, no group is added: it cannot be separated from shared errors.
    min_on_path: int = 30
    blocks: int = 8  # number of runs of pairs left out in turn on a path
    # A step that moves the predictions by less than this share of their posterior uncertainty is the last.
    small_step: float = 0.05
    noise_rounds: int = 4  # fixed-point rounds in which the noise settles well enough to compare correlations
    noise_rows: float = 10.0  # a prior's noise counts as this many coordinates
    # A given noise explains a sum of squared residuals up to this many of its standard deviations (χ²) above its mean.
    misfit_sigmas: float = 3.0


def innovations(series: FloatArray, correlation: float) -> FloatArray:
    """Return a series (n, ...) with first-order autoregressive errors, without the correlation with the previous entry.

    e_k = ρ e_{k−1} + √(1 − ρ²) fresh_k. The result has independent errors of the same size: Prais and Winsten 1954.
    """
    if correlation == 0.0:
        return series
    fresh = series.copy()
    fresh[1:] -= correlation * series[:-1]
    fresh[1:] /= math.sqrt(1.0 - correlation**2)
    return fresh


def most_probable(evidence: Callable[[float], float], present: float) -> float:
    """Return the correlation of the greatest log evidence in `correlations`, climbing from the current one.

    Returns 0 unless the pairs support one: it has to gain as much evidence as a group of deviations.
    """
    found: dict[int, float] = {}

    def at(place: int) -> float:
        if place not in found:
            found[place] = evidence(_Settings.correlations[place])
        return found[place]

    place, last = _Settings.correlations.index(present), len(_Settings.correlations) - 1
    while True:
        best = max((place, min(place + 1, last), max(place - 1, 0)), key=at)
        if best == place:
            return _Settings.correlations[place] if at(place) > at(0) + GroupSettings.price_nats else 0.0
        place = best


@dataclass(frozen=True, eq=False)
class ResidualFit:
    """Distorted chain with its uncertainty."""

    model: ResidualModel  # the fitted model
    noise: float  # estimated noise over unit; at least 1 where the units are the noise
    freedom: float  # residual coordinates minus the effective number of all weights
    shared: float  # correlation of the errors of neighbours on a path; 0 where pairs are apart
    inliers: BoolArray  # True for each pair (n,) that is not an outlier
    groups: tuple[str, ...]  # supported by the pairs or part of the prior; the model averages over others too


class _Fitter:
    """State of one fit: Gauss-Newton rounds, each of which selects groups and variances again.

    The prior's parameters, the chain's change and the weights of its groups, are the weights of the group "", counted
    in columns of the prior's root. Other weights, of the same groups or others, are added to them.
    """

    def __init__(self, prior: ResidualModel, pairs: Pairs, change: FloatArray) -> None:
        self._prior, self._features, self._pairs = prior, prior.features, pairs
        self._parameters = prior.features.parameters
        self._known = tuple(prior.weights)
        self._free, self._root = squared(prior.root)
        self._unit = math.sqrt(float(np.square(pairs.unit).mean()))
        self._least_noise = 1.0 if pairs.known else RobustSettings.rounding_m / float(pairs.unit.min())
        self._on_path = self._features.follow_a_path(pairs.q)
        self._present = np.concatenate([change, *prior.weights.values()])
        self._added: dict[str, FloatArray] = {}
        self.variances: dict[str, float] = {}
        self.noise, self.used, self.shared = math.inf, 0.0, 0.0
        self.inliers = np.ones(len(pairs), dtype=np.bool_)
        self._unfold()

    def _unfold(self) -> None:
        """Compute the chain and all weights at the current estimate."""
        size = self._parameters.size
        self.change = self._present[:size]
        self.chain = self._parameters.chain(self.change)
        self.weights: dict[str, FloatArray] = {}
        for group in dict.fromkeys((*self._known, *self._added)):
            self.weights[group] = self._added.get(group, np.zeros(self._features.size(group)))
        start = size
        for group in self._known:
            end = start + self._features.size(group)
            self.weights[group] = self.weights[group] + self._present[start:end]
            start = end

    def step(self, select: bool) -> float:
        """Step to the most probable weights; return the change of predictions over their uncertainty."""
        groups = self._candidate_groups() if select else tuple(self.variances)
        model = self._model(groups, select)
        model.variances = dict(self.variances)
        if select:
            model.select(groups)
        else:
            model.settle()
            model.prune()
        posterior = model.posterior()
        self.used = sum(posterior.used.values())
        parts = [np.zeros(len(self._free))]
        parts += [self._added.get(g, np.zeros(self._features.size(g))) for g in model.variances]
        step = posterior.mean - np.concatenate(parts)
        moved = model.square_of(step) / model.noise**2
        self.variances, self.noise = dict(model.variances), model.noise
        self._take(posterior.mean, tuple(model.variances))
        return math.sqrt(max(moved, 0.0) / max(self.used, 1.0))

    def average(self) -> Average:
        """Take the last step: to the mean over all probable sets of groups."""
        groups = self._candidate_groups()
        model = self._model(groups, ask_correlation=True)
        model.variances = dict(self.variances)
        average = model.average(() if self._on_path else groups)
        self._take(average.mean, average.groups)
        return average

    @property
    def chosen(self) -> tuple[str, ...]:
        """Groups of the prior and of the most probable set."""
        return tuple(dict.fromkeys((*self._known, *self.variances)))

    def _candidate_groups(self) -> tuple[str, ...]:
        """Return groups with no more features than coordinates; the largest only if the previous one is active."""
        coordinates = 3 * int(self.inliers.sum())
        if self._on_path and coordinates < _Settings.min_on_path:
            return tuple(self.variances)
        largest, before = SMOOTH_GROUPS[2], SMOOTH_GROUPS[1]

        def is_candidate(group: str) -> bool:
            if group in self.variances:
                return True
            return self._features.size(group) <= coordinates and (group != largest or before in self.variances)

        return tuple(group for group in self._features.groups() if is_candidate(group))

    def _select_inliers(self, residuals: FloatArray) -> None:
        """Select inliers by the larger of the middle residual and the noise of the last round."""
        norms = np.linalg.norm(residuals, axis=1)
        typical = max(float(np.median(norms)) / MEDIAN_NORM, self._least_noise)
        bound = typical if math.isinf(self.noise) else max(typical, self.noise)
        self.inliers = norms <= RobustSettings.outlier_sigmas * bound
        if math.isinf(self.noise):
            self.noise = typical

    def _model(self, groups: Sequence[str], ask_correlation: bool) -> GroupedModel:
        """Return the linear model around the current weights; those of the group "" are steps, the others' whole."""
        x = self._features.positions(self.chain, self.weights, self._pairs.q)
        residuals = self._pairs.whitened(self._pairs.x - x) / self._pairs.unit[:, None]
        self._select_inliers(residuals)
        rows = np.flatnonzero(self.inliers)
        if self._on_path:
            parts = min(
                max(len(rows) // BlockSettings.block_pairs, BlockSettings.min_blocks), _Settings.blocks, len(rows)
            )
        else:
            parts = max(len(rows) // _Settings.rows_at_once, 1)
        runs = np.array_split(rows, parts)
        if self._on_path and ask_correlation:
            self.shared = self._correlation(runs)
        sums = [_moments(*self._rows(run, groups), self.shared) for run in runs]
        return self._grouped(sums, groups, blocks=sums if self._on_path else ())

    def _grouped(self, sums: Sequence[Moments], groups: Sequence[str], blocks: Sequence[Moments] = ()) -> GroupedModel:
        sizes = [len(self._free), *(self._features.size(group) for group in groups)]
        ends = np.cumsum([0, *sizes]).tolist()
        spans = itertools.starmap(slice, itertools.pairwise(ends))
        offset = (self._prior.mean - self._present)[self._free]
        prior_noise = 0.0 if self._pairs.known else self._prior.noise / self._unit
        return GroupedModel(
            Moments.total(sums),
            dict(zip(("", *groups), spans, strict=True)),
            cast(FloatArray, np.linalg.solve(self._root, offset)),
            least_noise=self._least_noise,
            noise=self.noise,
            noise_before=(prior_noise, _Settings.noise_rows if prior_noise > 0.0 else 0.0),
            blocks=blocks,
        )

    def _correlation(self, runs: Sequence[IntArray]) -> float:
        """Return the most probable correlation of neighbours' errors in runs of pairs, with the current groups.

        The weights are integrated out: residuals show less correlation, because the weights follow the shared errors.
        """
        groups = tuple(self.variances)
        rows = [self._rows(run, groups) for run in runs]
        pairs = sum(len(run) - 1 for run in runs)

        def evidence(correlation: float) -> float:
            model = self._grouped([_moments(*part, correlation) for part in rows], groups)
            model.variances = dict(self.variances)
            model.settle(_Settings.noise_rounds)
            return model.posterior().log_evidence - 1.5 * pairs * math.log1p(-(correlation**2))

        return most_probable(evidence, self.shared)

    def _rows(self, run: IntArray, groups: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return rows (n, 3, P) and targets (n, 3) of some pairs, in units.

        The current part of the added groups is included in the target, since their weights are whole.
        """
        needed = tuple(dict.fromkeys((*groups, *self._known)))
        point = self._features.linearised(self.change, self.chain, self.weights, self._pairs.q[run], needed)
        target = self._pairs.x[run] - point.x
        for group, weights in self._added.items():
            target += point.groups[group] @ weights
        known = np.concatenate([point.chain, *(point.groups[group] for group in self._known)], axis=2)
        design = np.concatenate(
            [known[:, :, self._free] @ self._root, *(point.groups[group] for group in groups)], axis=2
        )
        pairs = self._pairs.chosen(run)
        return pairs.whitened(design) / pairs.unit[:, None, None], pairs.whitened(target) / pairs.unit[:, None]

    def _take(self, mean: FloatArray, groups: Sequence[str]) -> None:
        start = len(self._free)
        self._present[self._free] += self._root @ mean[:start]
        self._added = {}
        for group in groups:
            self._added[group] = mean[start : start + self._features.size(group)]
            start += self._features.size(group)
        self._unfold()

    def model(self, spread: FloatArray) -> ResidualModel:
        """Return the current weights as a model, with their uncertainty from the spread of the linear model."""
        ends = np.cumsum([self._parameters.size, *map(len, self.weights.values())]).tolist()
        places = dict(zip(self.weights, itertools.pairwise(ends), strict=True))
        root = np.zeros((ends[-1], spread.shape[1]))
        # The prior's groups come first, in its order.
        root[self._free] = self._root @ spread[: len(self._free)]
        start = len(self._free)
        for group, weights in self._added.items():
            begin, end = places[group]
            root[begin:end] += spread[start : start + len(weights)]
            start += len(weights)
        return ResidualModel(self._features, self.change, self.weights, root, self.noise * self._unit)


def fit_residual(prior: ResidualModel, pairs: Pairs, change: FloatArray) -> ResidualFit | None:
    """Fit around the most probable rigid chain, at `change`; return None if only a rigid chain is supported."""
    fitter = _Fitter(prior, pairs, change)
    for turn in range(_Settings.rounds):
        length = fitter.step(turn < _Settings.selections)
        rigid = not fitter.weights and fitter.shared == 0.0
        if rigid or (turn >= _Settings.selections - 1 and length < _Settings.small_step):
            break
    average = fitter.average()
    if not fitter.weights and fitter.shared == 0.0:
        return None
    freedom = max(3.0 * float(fitter.inliers.sum()) - fitter.used, 0.0)
    return ResidualFit(
        model=fitter.model(average.spread),
        noise=_given_unless_exceeded(fitter.noise, freedom) if pairs.known else fitter.noise,
        freedom=freedom,
        shared=fitter.shared,
        inliers=fitter.inliers,
        groups=fitter.chosen,
    )


def _moments(design: FloatArray, target: FloatArray, correlation: float) -> Moments:
    """Return the moments of rows (n, 3, P) and targets (n, 3), without the correlation of neighbours."""
    return Moments.of(
        innovations(design, correlation).reshape(-1, design.shape[2]), innovations(target, correlation).ravel()
    )


def _given_unless_exceeded(noise: float, freedom: float) -> float:
    """Return the given noise, 1, unless the residuals are larger than chance explains."""
    explained = freedom + _Settings.misfit_sigmas * math.sqrt(2.0 * freedom)
    return 1.0 if noise**2 * freedom <= explained else noise
