"""The most probable chain for a set of pairs: robust Gauss-Newton with a Gaussian prior."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.special import chdtrc  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from kbmaps.arrays import BoolArray, FloatArray
from kbmaps.chains.belief import ChainBelief, squared
from kbmaps.pairs import Pairs
from kbmaps.robust import RobustSettings, middle_sigma


class _Settings:
    """Settings of the robust fit of a chain.

    Sensitivity: each at 0.3 and 3 times changes error and sigma of a bent arm's models at 150 pairs by less than 1 %.
    """

    # Lower bound of a residual's variance as a share of the noise: below, the pair explains itself.
    min_share: float = 1e-4
    scales_per_sigma: float = 3.0
    # A given noise explains a sum of squared residuals unless its probability is below this (χ²).
    misfit_chance: float = 1e-3
    rounds: int = 80
    first_damping: float = 1e-3
    min_damping: float = 1e-12
    max_damping: float = 1e8
    # A step that changes the fit by less than this share of the posterior's standard deviation is the last.
    small_step: float = 1e-4


@dataclass(frozen=True)
class NoiseKnowledge:
    """Prior of an unknown noise, with the weight of a number of coordinates."""

    coordinates: float = 0.0  # that number, 0 without a prior
    square: float = 0.0  # their mean square [m²]

    def found(self, square: float, freedom: float) -> float:
        """Return the variance from a sum of squared residuals [m²]; `freedom + coordinates` must exceed 0."""
        return (square + self.coordinates * self.square) / (freedom + self.coordinates)


NO_NOISE_KNOWLEDGE = NoiseKnowledge()


@dataclass(frozen=True, eq=False)
class RigidFit:
    """Change of the chain with its uncertainty."""

    belief: ChainBelief  # the posterior of the parameters
    noise: float  # estimated noise over unit; at least 1 if the units are the noise (more: the chain does not fit)
    freedom: float  # residual coordinates minus the effective number of parameters
    inliers: BoolArray  # True for each pair (n,) that is not an outlier
    rank: int  # number of independent directions of the parameters that the data determine
    log_evidence: float  # log marginal likelihood of the inliers (Laplace's approximation)
    common: FloatArray  # most probable values (k,) of the unknowns shared by all pairs, in their sigmas


@dataclass(frozen=True, eq=False)
class _Point:
    """Residuals (n, 3) and Jacobian (n, 3, f), scaled to be isotropic, and norms in units (n,) at a change (size,).

    The f unknowns are the free parameters, counted from the prior's mean in columns of its root, then the errors common
    to all pairs in their sigmas; `offset` (f,) is their current value.
    """

    change: FloatArray
    residuals: FloatArray
    norms: FloatArray
    jacobian: FloatArray
    offset: FloatArray

    def reduced(self, roots: FloatArray) -> FloatArray:
        """Return the triangular factor (f+1, f+1) of the rows [J, residual], each pair's times its root (n,)."""
        rows = np.concatenate([self.jacobian, self.residuals[:, :, None]], axis=2) * roots[:, None, None]
        return cast(FloatArray, np.linalg.qr(rows.reshape(-1, rows.shape[2]), mode="r"))

    def deletion_distances(self, inliers: BoolArray, sigma: FloatArray) -> FloatArray:
        """Return the distance (n,) of each pair from its prediction by the other inliers, in standard deviations.

        Mahalanobis lengths: an inlier's residual has the covariance σ² − J P Jᵀ, an outlier's σ² + J P Jᵀ (Cook and
        Weisberg 1982, section 2.2). A pair's distance does not depend on its being part of the fit.
        """
        factor = self.reduced(inliers / sigma)
        _, singular, vt = np.linalg.svd(factor[:, :-1])
        singular = np.concatenate([singular, np.zeros(len(vt) - len(singular))])
        spread = self.jacobian @ (vt.T / np.sqrt(1.0 + np.square(singular))) / sigma[:, None, None]
        values, vectors = np.linalg.eigh(spread @ spread.swapaxes(1, 2))
        shares = 1.0 + np.where(inliers, -1.0, 1.0)[:, None] * values
        along = (vectors.swapaxes(1, 2) @ (self.residuals / sigma[:, None])[:, :, None])[:, :, 0]
        return np.sqrt((np.square(along) / np.maximum(shares, _Settings.min_share)).sum(axis=1))

    def cost(self, roots: FloatArray) -> float:
        residuals = np.einsum("ni,ni,n->", self.residuals, self.residuals, roots * roots)
        return float(residuals + self.offset @ self.offset)


class _Fitter:
    """State of one fit that minimises Σ (root ‖residual‖)² + ‖offset‖² with the roots of the current noise."""

    def __init__(self, prior: ChainBelief, pairs: Pairs, start: FloatArray) -> None:
        self.prior, self.pairs = prior, pairs
        self.free, self.root = squared(prior.root)
        common = np.zeros((len(pairs), 3, 0)) if pairs.common is None else pairs.common
        self._common = pairs.whitened(common)
        first = cast(FloatArray, np.linalg.solve(self.root, (start - prior.mean)[self.free]))
        self.point = self._at(np.concatenate([first, np.zeros(common.shape[2])]))
        self.least_noise = 1.0 if pairs.known else RobustSettings.rounding_m / float(pairs.unit.min())
        self._damping = _Settings.first_damping
        # Residual coordinates absorbed by the parameters.
        self.used = float(min(len(self.point.offset), 3 * len(pairs)))

    def typical(self) -> float:
        """Return the noise from the middle residual, divided by the unit."""
        norms = self.point.norms
        return max(middle_sigma(norms, 0.5 * (len(norms) + self.used / 3.0)), self.least_noise)

    def improve(self, weights: FloatArray, noise: float) -> float:
        """Take a Levenberg-Marquardt step; return its length in posterior sigmas (0: no better step found)."""
        point, roots = self.point, np.sqrt(weights) / (self.pairs.unit * noise)
        factor = point.reduced(roots)
        design, target = factor[:, :-1], factor[:, -1]
        before, columns = point.cost(roots), np.einsum("ij,ij->j", design, design)
        squares = np.square(np.linalg.svd(design, compute_uv=False))
        self.used = float((squares / (1.0 + squares)).sum())  # γ of MacKay 1992, "Bayesian interpolation"
        while self._damping <= _Settings.max_damping:
            damping_rows = np.sqrt(1.0 + self._damping * columns)
            q, r = np.linalg.qr(np.concatenate([design, np.diag(damping_rows)]))
            projected = q.T @ np.concatenate([target, -point.offset / damping_rows])
            length = float(np.linalg.norm(projected))
            trial = self._at(point.offset + np.linalg.solve(r, projected))
            if trial.cost(roots) <= before:
                self.point, self._damping = trial, max(self._damping * 0.1, _Settings.min_damping)
                return length
            if length < _Settings.small_step:
                return 0.0
            self._damping = max(self._damping * 10.0, _Settings.first_damping)
        self._damping = _Settings.first_damping
        return 0.0

    def _at(self, offset: FloatArray) -> _Point:
        change, own = self.prior.mean.copy(), len(self.free)
        change[self.free] += self.root @ offset[:own]
        x, jacobian = self.prior.parameters.linearised(change, self.pairs.q)
        residuals = self.pairs.whitened(self.pairs.x - x) - self._common @ offset[own:]
        norms = np.linalg.norm(residuals, axis=1) / self.pairs.unit
        by_free = self.pairs.whitened(jacobian[:, :, self.free] @ self.root)
        return _Point(change, residuals, norms, np.concatenate([by_free, self._common], axis=2), offset)


def fit_chain(
    prior: ChainBelief,
    pairs: Pairs,
    start: FloatArray,
    *,
    near: bool = False,
    noise: NoiseKnowledge = NO_NOISE_KNOWLEDGE,
) -> RigidFit:
    """Fit the most probable change to at least one pair, starting from `start` (size,).

    First graduated non-convexity (Yang et al. 2020): Geman-McClure weights, and with them the noise that weighs data
    against prior, shrink from the largest residual to the typical one. So neither outliers nor a marker far from its
    nominal position stop the fit. Then least squares on all inliers, with the noise estimated from them.

    Args:
        prior: Gaussian over the parameters before these pairs.
        pairs: the pairs, at least one.
        start: change (size,) to start from.
        near: True if the start is a fit to most of these pairs, so that least squares suffice.
        noise: prior of a noise that is not given.
    """
    fitter = _Fitter(prior, pairs, start)
    if not near:
        _anneal(fitter)
    return _polish(fitter, noise)


def rough_fit(prior: ChainBelief, pairs: Pairs, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a robust change (size,) within about a sigma of the fit, and its residuals (n, 3), whitened [m]."""
    fitter = _Fitter(prior, pairs, start)
    _anneal(fitter)
    return fitter.point.change, fitter.point.residuals


def folded(prior: ChainBelief, pairs: Pairs, change: FloatArray, noise: float) -> ChainBelief:
    """Return the posterior after inlier pairs, linearised at a change (size,).

    Args:
        prior: Gaussian over the parameters before these pairs.
        pairs: the pairs, without outliers.
        change: linearisation point (size,).
        noise: noise relative to the pairs' unit.
    """
    point = _Fitter(prior, pairs, change).point
    factor = point.reduced(1.0 / (pairs.unit * noise))
    free, root = squared(prior.root)
    prior_rows = np.concatenate([np.eye(len(free)), -point.offset[:, None]], axis=1)
    joined = cast(FloatArray, np.linalg.qr(np.concatenate([factor, prior_rows]), mode="r"))
    triangle, target = joined[: len(free), :-1], joined[: len(free), -1]
    mean, spread = prior.mean.copy(), np.zeros((len(prior.mean), len(free)))
    mean[free] += root @ (point.offset + np.linalg.solve(triangle, target))
    spread[free] = np.linalg.solve(triangle.T, root.T).T
    return ChainBelief(prior.parameters, mean, spread)


def _anneal(fitter: _Fitter) -> None:
    scale = math.inf
    for _ in range(_Settings.rounds):
        norms = fitter.point.norms
        goal = _Settings.scales_per_sigma * fitter.typical()
        scale = max(min(scale / 1.4, float(norms.max())), goal)
        step = fitter.improve((scale**2 / (scale**2 + norms**2)) ** 2, scale / _Settings.scales_per_sigma)
        if scale == goal and (step < 1.0 or scale <= 2.0 * _Settings.scales_per_sigma * fitter.least_noise):
            return


def _polish(fitter: _Fitter, prior_noise: NoiseKnowledge) -> RigidFit:
    pairs = fitter.pairs
    typical = fitter.typical()
    inliers = fitter.point.norms <= RobustSettings.outlier_sigmas * typical
    # Few pairs can be fitted with much noise or with little; a given noise is tried first.
    noise = 1.0 if pairs.known else typical
    freedom = 0.0
    for _ in range(_Settings.rounds):
        step = fitter.improve(inliers.astype(np.float64), noise)
        freedom = max(3.0 * float(inliers.sum()) - fitter.used, 0.0)
        square = float(np.square(fitter.point.norms[inliers]).sum())
        estimate = (
            _given_noise(square, freedom) if pairs.known else _estimated_noise(square, freedom, prior_noise, fitter)
        )
        distances = fitter.point.deletion_distances(inliers, pairs.unit * max(estimate, fitter.typical()))
        chosen = distances <= RobustSettings.outlier_sigmas
        settled = bool((chosen == inliers).all()) and abs(estimate - noise) <= 1e-3 * noise
        inliers, noise = chosen, estimate
        if settled and step < _Settings.small_step * math.sqrt(1.0 + freedom):
            break
    return _summary(fitter, inliers, noise, freedom)


def _estimated_noise(square: float, freedom: float, prior_noise: NoiseKnowledge, fitter: _Fitter) -> float:
    if freedom + prior_noise.coordinates == 0.0:
        return fitter.least_noise
    return max(math.sqrt(prior_noise.found(square, freedom)), fitter.least_noise)


def _given_noise(square: float, freedom: float) -> float:
    """Return 1, or more if the residuals exceed chance: then the chain does not fit."""
    if freedom == 0.0 or chdtrc(freedom, square) >= _Settings.misfit_chance:
        return 1.0
    return max(math.sqrt(square / freedom), 1.0)


def _summary(fitter: _Fitter, inliers: BoolArray, noise: float, freedom: float) -> RigidFit:
    point, free, root = fitter.point, fitter.free, fitter.root
    parameters, size = fitter.prior.parameters, fitter.prior.parameters.size
    factor = point.reduced(inliers / (fitter.pairs.unit * noise))
    _, singular, vt = np.linalg.svd(factor[:, :-1])
    singular = np.concatenate([singular, np.zeros(len(vt) - len(singular))])
    rank = _rank(cast(FloatArray, np.linalg.solve(root.T, factor[:, : len(free)].T)).T)
    spread = np.zeros((size, len(vt)))
    spread[free] = root @ (vt.T / np.sqrt(1.0 + np.square(singular)))[: len(free)]
    square = float(np.square(point.norms[inliers]).sum()) / noise**2 + float(point.offset @ point.offset)
    spans = 6.0 * float(np.log(noise * fitter.pairs.unit[inliers]).sum())
    evidence = -0.5 * (square + spans + 3.0 * float(inliers.sum()) * math.log(2.0 * math.pi))
    evidence -= 0.5 * float(np.log1p(np.square(singular)).sum())
    seen = noise * math.sqrt(float(np.square(fitter.pairs.unit).mean())) if freedom > 0.0 else 0.0
    belief = ChainBelief(parameters, point.change, spread, seen)
    return RigidFit(belief, noise, freedom, inliers, rank, evidence, point.offset[len(free) :])


def _rank(design: FloatArray) -> int:
    """Return the number of parameter directions that the rows determine."""
    lengths = np.linalg.norm(design, axis=0)
    seen = lengths > 1e-12 * max(float(lengths.max(initial=0.0)), 1e-300)
    singular = np.linalg.svd(design[:, seen] / lengths[seen], compute_uv=False)
    return int((singular > 1e-8 * singular.max(initial=0.0)).sum())
