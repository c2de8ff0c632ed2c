"""Fits of a tensor train with the noise and the outliers estimated from the data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation  # pyright: ignore[reportMissingTypeStubs]

from kbmaps.arrays import BoolArray, FloatArray
from kbmaps.chains.chain import RigidChain
from kbmaps.maps.basis import JointBasis
from kbmaps.robust import MEDIAN_NORM
from kbmaps.trains.core_prior import CorePrior
from kbmaps.trains.fit import LevenbergMarquardt, TensorProblem, alternate
from kbmaps.trains.train import TensorTrain


class SearchSettings:
    noise_floor: float = 1e-13  # Relative to the spread of the positions: smaller residuals are rounding
    # With residuals below this share of the positions' spread, no further start is needed.
    explained: float = 1e-4
    first_noise: float = 2e-2
    sweeps: int = 40
    first_steps: int = 30
    round_steps: int = 6
    rounds: int = 40
    same_noise: float = 0.02
    # A pair farther than this many robust standard deviations is an outlier: 1.5e-5 of good pairs are.
    outlier_distance: float = 5.0
    weight_scale: float = 4.0
    same_lengths: float = 0.05  # reweighting ends when no residual moves by more than this many standard deviations
    search_pairs: int = 40  # random starts use at most this many pairs per joint
    min_freedom: float = 0.2  # with fewer degrees of freedom per pair, residuals cannot separate noise from outliers
    plausible: float = 0.1  # failed starts leave a tenth or more of the spread, and may agree on it by chance


@dataclass(frozen=True, eq=False)
class Pairs:
    """Checked pairs."""

    weights: FloatArray  # basis functions (n, d, 3)
    x: FloatArray  # positions (n, 3) [m]
    sigma: FloatArray  # 1-sigma of a coordinate (n,) [m]; NaN where it is not known

    @property
    def unknown(self) -> BoolArray:
        """True for each pair (n,) without a sigma."""
        return np.isnan(self.sigma)

    @property
    def size(self) -> float:
        """RMS distance of the positions from their mean [m]; 1 m if they are all the same."""
        spread = math.sqrt(float(self.x.var(axis=0).sum()))
        return spread if spread > 0.0 else 1.0

    @property
    def noise_floor(self) -> float:
        """Size below which residuals are rounding [m]."""
        return SearchSettings.noise_floor * self.size

    def chosen(self, mask: BoolArray) -> Pairs:
        return Pairs(self.weights[mask], self.x[mask], self.sigma[mask])

    def problem(self, prior: CorePrior, noise: float, factors: FloatArray | None = None) -> TensorProblem:
        """Return the problem with `noise` [m] for pairs without a sigma, and variances divided by `factors` (n,)."""
        std = np.where(self.unknown, noise, self.sigma)
        return TensorProblem(self.weights, self.x, std if factors is None else std / np.sqrt(factors), prior)


@dataclass(frozen=True, eq=False)
class Fit:
    """Whitened cores z, the noise of a coordinate [m], and True for each pair (n,) that was used."""

    z: FloatArray
    noise: float
    used: BoolArray


def refine(pairs: Pairs, prior: CorePrior, z: FloatArray, noise: float, *, robust: bool = True) -> Fit:
    """Return the most likely train near z, with the noise estimated in turn, and without the outliers."""
    plain = _settle(pairs, prior, z, noise)
    everything = np.ones(len(pairs.x), dtype=np.bool_)
    if not robust:
        return replace(plain, used=everything)
    good = _inlier_mask(pairs, prior, plain)
    if good.all():
        return replace(plain, used=everything)
    fit = _reweighted(pairs, prior, plain)
    good = _inlier_mask(pairs, prior, fit)
    for _ in range(10):
        fit = _settle(pairs.chosen(good), prior, fit.z, fit.noise)
        now = _inlier_mask(pairs, prior, fit)
        if (now == good).all():
            break
        good = now
    return replace(fit, used=good)


def search(
    pairs: Pairs,
    prior: CorePrior,
    bases: Sequence[JointBasis],
    rng: np.random.Generator,
    starts: int,
    *,
    robust: bool = True,
) -> Fit:
    """Return the best of several fits from random rigid chains.

    Ends early if one explains the pairs, or two agree.
    """
    sample = pairs
    if len(pairs.x) > SearchSettings.search_pairs * len(bases):
        mask = np.zeros(len(pairs.x), dtype=np.bool_)
        mask[rng.permutation(len(pairs.x))[: SearchSettings.search_pairs * len(bases)]] = True
        sample = pairs.chosen(mask)
    best = _fit_from_random_chain(sample, prior, bases, rng)
    for _ in range(starts - 1):
        if best.noise < SearchSettings.explained * pairs.size:
            break
        fit = _fit_from_random_chain(sample, prior, bases, rng)
        plausible = best.noise < SearchSettings.plausible * pairs.size
        agrees = plausible and abs(fit.noise / best.noise - 1.0) < SearchSettings.same_noise
        best = min(best, fit, key=lambda candidate: candidate.noise)
        if agrees:
            break
    return refine(pairs, prior, best.z, best.noise, robust=robust)


def _fit_from_random_chain(
    pairs: Pairs, prior: CorePrior, bases: Sequence[JointBasis], rng: np.random.Generator
) -> Fit:
    noise = SearchSettings.first_noise * pairs.size
    chain = random_chain(bases, pairs.size / math.sqrt(len(bases)), rng)
    # A small given sigma would make the objective of the first steps rugged.
    problem = TensorProblem(pairs.weights, pairs.x, np.full(len(pairs.x), noise), prior)
    z = alternate(problem, prior.whitened(TensorTrain.from_chain(chain, bases).cores), SearchSettings.sweeps)
    z, _ = LevenbergMarquardt().run(problem, z, SearchSettings.first_steps)
    rms = math.sqrt(float(np.square(problem.residuals(z)).mean()))
    if rms > SearchSettings.plausible * pairs.size:
        # Most failed starts are evident by now; converging them would take longer than the next start.
        return Fit(z, rms, np.ones(len(pairs.x), dtype=np.bool_))
    unweighted = Pairs(pairs.weights, pairs.x, np.full(len(pairs.x), np.nan))
    return _settle(unweighted, prior, z, noise)


def random_chain(bases: Sequence[JointBasis], length: float, rng: np.random.Generator) -> RigidChain:
    """Return a chain with random axes and links of about `length` [m] for joints of the bases' kinds."""
    joints = len(bases)
    fixed = np.tile(np.eye(4), (joints + 1, 1, 1))
    fixed[:, :3, :3] = Rotation.random(joints + 1, rng=rng).as_matrix()
    fixed[:, :3, 3] = length * rng.normal(size=(joints + 1, 3))
    axes = rng.normal(size=(joints, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return RigidChain(fixed, axes, np.array([basis.is_prismatic for basis in bases]))


def information(pairs: Pairs, prior: CorePrior, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Return JᵀJ (36 d, 36 d) of the pairs that a fit used, by z: the information beyond the prior's unit matrix.

    Also returns the standard deviation of a coordinate of each (n,) [m] as weighted. If every sigma was given but the
    residuals are larger, all are scaled up accordingly.
    """
    good = pairs.chosen(fit.used)
    problem = good.problem(prior, fit.noise)
    jacobian = problem.scaled_jacobian(fit.z)
    matrix = jacobian.T @ jacobian
    if good.unknown.any():
        return matrix, problem.std
    square = float(np.square(problem.residuals(fit.z) / problem.std[:, None]).sum())
    freedom = 3.0 * len(good.x) - effective_parameters(problem, fit.z)
    excess = max(square / freedom, 1.0) if freedom > 1.0 else 1.0
    return matrix / excess, problem.std * math.sqrt(excess)


def effective_parameters(problem: TensorProblem, z: FloatArray) -> float:
    """Return the number of parameters that the pairs determine against the prior.

    Σ λ / (1 + λ) over the eigenvalues λ of JᵀJ.
    """
    jacobian = problem.scaled_jacobian(z)
    gram = jacobian @ jacobian.T if jacobian.shape[0] < jacobian.shape[1] else jacobian.T @ jacobian
    values = np.maximum(np.linalg.eigvalsh(gram), 0.0)
    return float((values / (1.0 + values)).sum())


def _settle(pairs: Pairs, prior: CorePrior, z: FloatArray, noise: float) -> Fit:
    """Fit z and noise in turn until both have converged.

    The noise follows MacKay 1992: rss / (3 n − effective parameters).
    """
    optimiser = LevenbergMarquardt()
    used = np.ones(len(pairs.x), dtype=np.bool_)
    for _ in range(SearchSettings.rounds):
        problem = pairs.problem(prior, noise)
        z, _ = optimiser.run(problem, z, SearchSettings.round_steps)
        if not pairs.unknown.any():
            noise = math.sqrt(float(np.square(pairs.sigma).mean()))
            if optimiser.converged:
                break
            continue
        freedom = 1.0 - effective_parameters(problem, z) / (3.0 * len(pairs.x))
        mean_square = float(np.square(problem.residuals(z))[pairs.unknown].mean())
        found = max(math.sqrt(mean_square / max(freedom, 1e-9)), pairs.noise_floor)
        steady = abs(found / noise - 1.0) < SearchSettings.same_noise
        noise = found
        if (optimiser.converged and steady) or found == pairs.noise_floor:
            break
    return Fit(z, noise, used)


def _distances(pairs: Pairs, prior: CorePrior, fit: Fit) -> tuple[FloatArray, bool]:
    """Return residuals' lengths (n,) in robust standard deviations, and True if these are meaningful.

    The unit comes from the median; if every sigma is given, it is at least that.
    """
    problem = pairs.problem(prior, fit.noise)
    freedom = 1.0 - effective_parameters(problem, fit.z) / (3.0 * len(pairs.x))
    lengths = np.linalg.norm(problem.residuals(fit.z), axis=1) / problem.std
    unit = float(np.median(lengths)) / (MEDIAN_NORM * math.sqrt(max(freedom, SearchSettings.min_freedom)))
    rounding = fit.noise <= 2.0 * pairs.noise_floor
    least = pairs.noise_floor / fit.noise if pairs.unknown.any() else 1.0
    return lengths / max(unit, least), freedom >= SearchSettings.min_freedom and not rounding


def _inlier_mask(pairs: Pairs, prior: CorePrior, fit: Fit) -> BoolArray:
    """Return True for each pair (n,) whose distance from the fit is within the noise."""
    lengths, is_meaningful = _distances(pairs, prior, fit)
    return lengths <= SearchSettings.outlier_distance if is_meaningful else np.ones(len(lengths), dtype=np.bool_)


def _reweighted(pairs: Pairs, prior: CorePrior, fit: Fit) -> Fit:
    """Return an iteratively reweighted fit with Geman and McClure's weights (1 + r²)⁻²."""
    optimiser = LevenbergMarquardt()
    z = fit.z
    for _ in range(SearchSettings.rounds):
        lengths, _ = _distances(pairs, prior, replace(fit, z=z))
        factors = 1.0 / np.square(1.0 + np.square(lengths / SearchSettings.weight_scale))
        problem = pairs.problem(prior, fit.noise, factors)
        z, _ = optimiser.run(problem, z, SearchSettings.round_steps)
        moved = float(np.abs(_distances(pairs, prior, replace(fit, z=z))[0] - lengths).max())
        if optimiser.converged and moved < SearchSettings.same_lengths:
            break
    return replace(fit, z=z)
