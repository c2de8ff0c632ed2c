"""Gaussian inference on KB-Maps with as many unknowns as pairs: no vector of 3^d numbers is formed.

Positions are y = r + e with a KB-Map r whose coefficients are N(0, τ²) each, so that r has the covariance τ² k(q, q'),
and noise e of variance s². With λ = s² / τ² everything follows from one Cholesky factorisation of K + λ I (Rasmussen
and Williams, Gaussian Processes for Machine Learning, 2006, section 2.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.errors import SettingError
from kbmaps.maps.basis import JointBasis
from kbmaps.maps.evidence import LinearEvidence, most_evident
from kbmaps.maps.exact import ExactSettings
from kbmaps.maps.factor import ShiftedGram
from kbmaps.maps.stack import BasisStack
from kbmaps.robust import RobustSettings


class ProductKernel:
    """Kernel k(q, q') = w(q) · w(q') = Π_k w_k(q_k) · w_k(q'_k), with the 3^d weights w never formed.

    The inner product of two Kronecker products is the product of their factors' inner products. An entry costs 3 d
    multiplications, for any number of joints d. Inputs are not checked: callers validate them.
    """

    def __init__(self, bases: Sequence[JointBasis]) -> None:
        self.bases = tuple(bases)
        self.joints = len(self.bases)
        self._stack = BasisStack(self.bases)

    def joint_weights(self, q: FloatArray) -> FloatArray:
        """Return the weights of every joint (n, d, 3) at configurations q (n, d), the input of the kernel."""
        return self._stack.joint_weights(q)

    def between(self, weights: FloatArray, others: FloatArray) -> FloatArray:
        """Return the kernel (n, m) between configurations given by their joint weights (n, d, 3) and (m, d, 3)."""
        kernel = weights[:, 0] @ others[:, 0].T
        factor = np.empty_like(kernel)
        for k in range(1, self.joints):
            np.matmul(weights[:, k], others[:, k].T, out=factor)
            kernel *= factor
        return kernel

    def diagonal(self, weights: FloatArray) -> FloatArray:
        """Return k(q, q) (n,) of configurations given by their joint weights (n, d, 3)."""
        return np.square(weights).sum(axis=2).prod(axis=1)


Precision = float | Literal["evidence"] | None


class _Settings:
    """Settings of the fit of a kernel.

    Sensitivity: each at 0.3 and 3 times changes error and sigma of a bent arm's models at 150 pairs by less than 1 %,
    but for `search_start` by 4 %.
    """

    search_start: float = 1e-4  # start of the search for λ, relative to the mean diagonal of the Gram matrix
    # Relative to the trace of the Gram matrix: just enough for a stable Cholesky factorisation.
    vanishing_ridge: float = 1e-15
    # The refinement of the exact solution ends when a step no longer reduces the residual to this share.
    refinements: int = 200
    progress: float = 0.95
    block: int = 256


@dataclass(frozen=True, eq=False)
class Observations:
    """Pairs in the form of the inference: rows multiplied by `scale`, so that their noise is equal."""

    weights: FloatArray  # of every joint (n, d, 3)
    scale: FloatArray  # roots (n,) of the pairs' weights
    errors: FloatArray  # scaled residuals of the prior's mean (n, 3)
    count: float  # effective number of pairs; less than n where some are partly forgotten
    log_weights: float  # sum of the logarithms of the pairs' inverse variances
    noise_known: bool  # True if the noise of the scaled errors is 1; False if it is to be estimated


class KernelFit:
    """Posterior after some observations.

    Args:
        kernel: the product kernel.
        observations: the pairs.
        precision: λ; "evidence" selects the most probable one; None explains the pairs exactly by the smallest
            coefficients, provided that no pair contradicts another.

    Attributes:
        precision: λ; 0 for the exact one.
        noise_variance: s² of the scaled errors [m²; 1 if known].
        prior_variance: τ² of the map's coefficients [m²].
        log_evidence: log marginal likelihood at λ; None for the exact one.

    Raises:
        SettingError: λ is below rounding for these pairs.
    """

    def __init__(self, kernel: ProductKernel, observations: Observations, precision: Precision) -> None:
        self._kernel = kernel
        self._seen = observations
        self._gram = ShiftedGram(self._scaled_gram())
        if precision is None:
            self._explain_exactly()
            return
        if isinstance(precision, str):
            mean = self._gram.trace / len(observations.scale)
            low, high = (limit * mean for limit in ExactSettings.search_limits)
            # With few pairs, the evidence may be flat towards τ = 0, a prior mean that is right everywhere. A density
            # of τ that is flat there (Gelman 2006) keeps τ, and so the predicted uncertainty, at the value that the
            # pairs support.
            precision = most_evident(
                lambda tried: self._log_evidence(tried) - 0.5 * math.log1p(tried / mean),
                _Settings.search_start * mean,
                low,
                high,
            )
        self._condition(precision)

    def mean(self, weights: FloatArray) -> FloatArray:
        """Return the posterior mean minus the prior's (m, 3), for joint weights (m, d, 3)."""
        return np.concatenate([self._kernel_rows(part) @ self._multipliers for part in _parts(weights)])

    def variance(self, weights: FloatArray) -> FloatArray:
        """Return the posterior variance (m,) of each coordinate without noise [m²]."""
        return self.prior_variance * self._left_open(weights)

    def unexplained(self, weights: FloatArray) -> FloatArray:
        """Return the share (m,) in 0..1 of the map's prior variance that remains after the pairs."""
        return self._left_open(weights) / self._kernel.diagonal(weights)

    def _left_open(self, weights: FloatArray) -> FloatArray:
        """Return k(q, q) − kᵀ (K + λ I)⁻¹ k (m,)."""
        parts = (self._kernel_rows(part) for part in _parts(weights))
        taken = [np.einsum("mn,nm->m", rows, self._gram.solve(rows.T)) for rows in parts]
        return np.clip(self._kernel.diagonal(weights) - np.concatenate(taken), 0.0, None)

    def _kernel_rows(self, weights: FloatArray) -> FloatArray:
        return self._kernel.between(weights, self._seen.weights) * self._seen.scale

    def _scaled_gram(self) -> FloatArray:
        """Return K (n, n) of the scaled rows, its upper triangle, Fortran-ordered."""
        weights, scale = self._seen.weights, self._seen.scale
        size = len(scale)
        gram = np.zeros((size, size), order="F")
        for start in range(0, size, _Settings.block):
            end = min(start + _Settings.block, size)
            block = self._kernel.between(weights[:end], weights[start:end])
            gram[:end, start:end] = block * scale[:end, None] * scale[start:end]
        return gram

    def _times_gram(self, multipliers: FloatArray) -> FloatArray:
        """Return K @ multipliers, recomputing K's entries: the factorisation has overwritten them."""
        products = [self._kernel_rows(part) @ multipliers for part in _parts(self._seen.weights)]
        return np.concatenate(products) * self._seen.scale[:, None]

    def _evidence_of_noise(self, precision: float) -> LinearEvidence:
        """Return the evidence of s² at λ. K + λ I must be factorised."""
        # Whitened by (K / λ + I)^(-1/2), the errors have equal independent noise.
        errors = math.sqrt(precision) * self._gram.whiten(self._seen.errors)
        none = np.zeros(0)
        return LinearEvidence(3.0 * self._seen.count, float(np.square(errors).sum()), none, none)

    def _log_evidence(self, precision: float) -> float:
        if not self._gram.factorise(precision):
            return -math.inf
        evidence = self._evidence_of_noise(precision)
        return self._complete(evidence, precision, self._noise_variance(evidence))

    def _noise_variance(self, evidence: LinearEvidence) -> float:
        return 1.0 if self._seen.noise_known else evidence.best_variance()

    def _complete(self, evidence: LinearEvidence, precision: float, noise_variance: float) -> float:
        """Return the log evidence with the determinants that whitening and scaling left out."""
        spread = self._gram.log_determinant - len(self._seen.scale) * math.log(precision)
        return float(evidence.at(np.array([noise_variance]))[0]) + 1.5 * (self._seen.log_weights - spread)

    def _condition(self, precision: float) -> None:
        """Compute the posterior at λ."""
        if not self._gram.factorise(precision):
            raise SettingError(f"precision = {precision:.3g} is below rounding here; use None or a larger one")
        evidence = self._evidence_of_noise(precision)
        variance = self._noise_variance(evidence)
        self.precision, self.noise_variance = precision, variance
        self.prior_variance = variance / precision
        self.log_evidence: float | None = self._complete(evidence, precision, variance)
        errors = self._seen.errors
        multipliers = self._gram.solve(errors)
        # One step of refinement corrects the rounding of the factorisation.
        remaining = errors - self._times_gram(multipliers) - precision * multipliers
        self._multipliers = multipliers + self._gram.solve(remaining)

    def _explain_exactly(self) -> None:
        """Compute the smallest coefficients that explain the errors. Iterated Tikhonov, as `ExactLearner` without λ."""
        errors = self._seen.errors
        ridge = _Settings.vanishing_ridge * self._gram.trace
        while not self._gram.factorise(ridge):
            ridge *= 10.0
        self._multipliers = self._gram.solve(errors)
        left = math.inf
        for _ in range(_Settings.refinements):
            remaining = errors - self._times_gram(self._multipliers)
            size = float(np.linalg.norm(remaining))
            if not size < _Settings.progress * left:
                break
            left = size
            self._multipliers = self._multipliers + self._gram.solve(remaining)
        self.precision, self.noise_variance, self.log_evidence = 0.0, 0.0, None
        # At λ = 0 the evidence is greatest at this variance of the coefficients.
        square = float(np.vdot(errors, self._multipliers)) / (3.0 * self._seen.count)
        self.prior_variance = max(square, RobustSettings.variance_floor)


def _parts(weights: FloatArray) -> list[FloatArray]:
    """Return blocks of rows; one empty block if there are no rows."""
    return [weights[start : start + _Settings.block] for start in range(0, max(len(weights), 1), _Settings.block)]
