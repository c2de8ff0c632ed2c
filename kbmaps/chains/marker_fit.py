"""Position of a marker on the last link, in closed form: x = f(q) + R(q) δ is linear in δ."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray
from kbmaps.maps.evidence import LinearEvidence
from kbmaps.robust import MEDIAN_NORM, ROUNDING_M

_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a model at n configurations.

    Attributes:
        rotations: R(q) (n, 3, 3) of the model.
        errors: x − f(q) (n, 3) [m].
        sigma: 1-sigma of each (n,) [m], NaN where unknown.
    """

    rotations: FloatArray
    errors: FloatArray
    sigma: FloatArray

    def __len__(self) -> int:
        return len(self.errors)

    def __getitem__(self, chosen: slice | BoolArray) -> Residuals:
        return Residuals(self.rotations[chosen], self.errors[chosen], self.sigma[chosen])

    def joined(self, more: Residuals) -> Residuals:
        """Return these residuals followed by `more`."""
        # C order, whatever the model's: sums must not depend on a memory layout that is lost in bytes.
        return Residuals(
            np.ascontiguousarray(np.concatenate([self.rotations, more.rotations])),
            np.concatenate([self.errors, more.errors]),
            np.concatenate([self.sigma, more.sigma]),
        )

    def norms(self, shift: FloatArray) -> FloatArray:
        """Return the distances (n,) [m] that remain with a marker offset (3,)."""
        return np.linalg.norm(self.errors - self.rotations @ shift, axis=1)


@dataclass(frozen=True, eq=False)
class MarkerKnowledge:
    """Sufficient statistics of δ and the noise; the order of the pairs does not matter.

    Attributes:
        information, pull: Λ (3, 3) [1/m²] and Λ m (3,) [1/m] of a Gaussian N(m, Λ⁻¹) of δ: the prior, and the pairs
            with a given sigma.
        square, inner, count: of the pairs of unknown noise, Σ Rᵀ R (3, 3), Σ Rᵀ e (3,) and their number.
        errors: Σ eᵀ e of these [m²].
        noise_count, noise_square: prior of their noise, as a number of coordinates and the sum of their squares.
    """

    information: FloatArray
    pull: FloatArray
    square: FloatArray
    inner: FloatArray
    errors: float
    count: float
    noise_count: float
    noise_square: float

    @classmethod
    def before(cls, shift: FloatArray, covariance: FloatArray, noise: float, noise_count: float) -> Self:
        """Return the prior of an offset and the noise.

        Args:
            shift: mean of the offset (3,) [m].
            covariance: of the offset (3, 3) [m²].
            noise: 1-sigma of a coordinate [m].
            noise_count: number of coordinates that the noise counts for.
        """
        information: FloatArray = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        return cls(
            information,
            information @ shift,
            np.zeros((3, 3)),
            np.zeros(3),
            0.0,
            0.0,
            noise_count,
            noise_count * noise**2,
        )

    def given(self, pairs: Residuals) -> MarkerKnowledge:
        """Return the statistics updated with these pairs."""
        told = ~np.isnan(pairs.sigma)
        known, other = pairs[told], pairs[~told]
        weights = 1.0 / np.square(known.sigma)
        return replace(
            self,
            information=self.information + np.einsum("n,nki,nkj->ij", weights, known.rotations, known.rotations),
            pull=self.pull + np.einsum("n,nki,nk->i", weights, known.rotations, known.errors),
            square=self.square + np.einsum("nki,nkj->ij", other.rotations, other.rotations),
            inner=self.inner + np.einsum("nki,nk->i", other.rotations, other.errors),
            errors=self.errors + float(np.vdot(other.errors, other.errors)),
            count=self.count + len(other),
        )

    def posterior(self) -> MarkerPosterior:
        """Return the posterior of the offset, with the noise that maximises the evidence."""
        covariance = np.linalg.inv(self.information)
        centre = covariance @ self.pull
        root = np.linalg.cholesky(0.5 * (covariance + covariance.T))
        eigenvalues, directions = np.linalg.eigh(root.T @ self.square @ root)
        left = self.inner - self.square @ centre
        misfit = max(self.errors - float(centre @ (self.inner + left)), 0.0)
        eigenvalues = np.maximum(eigenvalues, 0.0)
        pulled = directions.T @ root.T @ left
        along = np.divide(pulled, np.sqrt(eigenvalues), out=np.zeros(3), where=eigenvalues > 0.0)
        noise = LinearEvidence(
            3.0 * self.count + self.noise_count,
            max(misfit - float(along @ along), 0.0) + self.noise_square,
            eigenvalues,
            along,
        )
        variance = noise.best_variance()
        axes = root @ directions
        return MarkerPosterior(
            shift=centre + axes @ noise.mean(variance),
            covariance=(axes * (variance / (variance + eigenvalues))) @ axes.T,
            noise=math.sqrt(variance),
        )


@dataclass(frozen=True, eq=False)
class MarkerPosterior:
    """Posterior of δ (3,) [m]: mean, covariance (3, 3) [m²], and noise of a coordinate [m] where it was not given."""

    shift: FloatArray
    covariance: FloatArray
    noise: float


def fit_marker(
    before: MarkerKnowledge, pairs: Residuals, outlier_sigmas: float
) -> tuple[MarkerKnowledge, MarkerPosterior, BoolArray]:
    """Fit by least squares over the inliers; return the statistics, the posterior, and the inliers (n,).

    Starts from the median of the single pairs' estimates, so that up to half of them may be arbitrary. Fewer than five
    pairs have no majority, and all count.
    """
    inliers = np.ones(len(pairs), dtype=np.bool_)
    if len(pairs):
        singles = (pairs.rotations.swapaxes(1, 2) @ pairs.errors[..., None])[..., 0]
        inliers = _near(pairs, np.median(singles, axis=0), outlier_sigmas)
    for _ in range(_ROUNDS):
        known = before.given(pairs[inliers])
        posterior = known.posterior()
        chosen = _near(pairs, posterior.shift, outlier_sigmas)
        if (chosen == inliers).all():
            break
        inliers = chosen
    else:
        known = before.given(pairs[inliers])
        posterior = known.posterior()
    return known, posterior, inliers


def _near(pairs: Residuals, shift: FloatArray, outlier_sigmas: float) -> BoolArray:
    """Return True for each pair (n,) within `outlier_sigmas` robust standard deviations.

    The robust standard deviation is at least the given sigma.
    """
    norms = pairs.norms(shift)
    told = ~np.isnan(pairs.sigma)
    limits = np.full(len(norms), ROUNDING_M)
    if told.any():
        sigma = pairs.sigma[told]
        limits[told] += outlier_sigmas * sigma * max(_spread(norms[told] / sigma), 1.0)
    if not told.all():
        limits[~told] += outlier_sigmas * _spread(norms[~told])
    return norms <= limits


def _spread(norms: FloatArray) -> float:
    """Return the standard deviation of a coordinate from the middle norm.

    Its rank lies above the median by the one pair that an offset can always explain (Rousseeuw and Leroy 1987, least
    median of squares). Otherwise a few pairs would fit perfectly and the others would count as outliers.
    """
    rank = min(len(norms) // 2 + 1, len(norms) - 1)
    return float(np.partition(norms, rank)[rank]) / MEDIAN_NORM
