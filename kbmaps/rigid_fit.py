"""The most probable chain for a set of pairs: robust Gauss-Newton with a Gaussian prior."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray
from kbmaps.chain_parameters import WIDE, ChainParameters
from kbmaps.pairs import Pairs

# Noise that is estimated is never below this [m]: there rounding begins.
_ROUNDING_M = 1e-9
# A pair beyond this many sigma is an outlier: of good ones 3 in 100,000 are as far out (chi, three dimensions).
_OUTLIER_SIGMAS = 4.8
# A residual norm of noise σ per axis has the median 1.538 σ in three dimensions.
_MEDIAN_NORM = 1.538
_SCALES_PER_SIGMA = 3.0
_ROUNDS = 80
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-12, 1e8
# A step that changes the fit by less than this share of what the noise leaves open is the last.
_SMALL_STEP = 1e-4


@dataclass(frozen=True, eq=False)
class RigidFit:
    """A change of the chain and how sure it is.

    Attributes:
        change: the most probable parameters (size,).
        noise: estimated noise over unit; at least 1 where the units are the noise (more: the chain does not fit).
        freedom: residual coordinates minus those that the parameters have used up.
        inliers: which pairs (n,) are no outliers.
        spread: matrix W (size, size) with the posterior covariance W Wᵀ [rad², m²].
        rank: how many independent directions of the parameters the data determine.
        loose: how far (size,) each free parameter takes part in directions that the data do not show, in 0..1.
        log_evidence: log marginal likelihood of the inliers (Laplace's approximation).
    """

    change: FloatArray
    noise: float
    freedom: float
    inliers: BoolArray
    spread: FloatArray
    rank: int
    loose: FloatArray
    log_evidence: float


class _Linearised:
    """Residuals and Jacobian at one change, in parameters of unit prior variance."""

    def __init__(self, parameters: ChainParameters, pairs: Pairs, scales: FloatArray, free: BoolArray) -> None:
        self._parameters, self._pairs = parameters, pairs
        self._scales, self._free = scales, free

    def at(self, change: FloatArray) -> None:
        x, jacobian = self._parameters.linearised(change, self._pairs.q)
        self.change = change
        self.residuals = self._pairs.x - x
        self.norms = np.linalg.norm(self.residuals, axis=1) / self._pairs.unit
        self.jacobian = jacobian[:, :, self._free] * self._scales
        self.offset = change[self._free] / self._scales

    def reduced(self, roots: FloatArray) -> FloatArray:
        """Triangular factor (f+1, f+1) of the rows [J, residual], each pair's multiplied by its root (n,)."""
        rows = np.concatenate([self.jacobian, self.residuals[:, :, None]], axis=2) * roots[:, None, None]
        return cast(FloatArray, np.linalg.qr(rows.reshape(-1, rows.shape[2]), mode="r"))

    def moved(self, step: FloatArray) -> FloatArray:
        change = self.change.copy()
        change[self._free] += self._scales * step
        return change


class _Fitter:
    """One fit on its way: what is minimised is Σ (root ‖residual‖)² + ‖offset‖² with the roots of the present noise."""

    def __init__(self, parameters: ChainParameters, std: FloatArray, pairs: Pairs, start: FloatArray) -> None:
        self.parameters, self.pairs = parameters, pairs
        self.free = std > 0.0
        self.scales = np.minimum(std[self.free], WIDE)
        self.linear = _Linearised(parameters, pairs, self.scales, self.free)
        self.linear.at(start)
        self.least_noise = 1.0 if pairs.known else _ROUNDING_M / float(pairs.unit.min())
        self.damping = _FIRST_DAMPING
        self.used = float(min(self.free.sum(), 3 * len(pairs)))

    def typical(self) -> float:
        """Noise over unit as the middle residual shows it (Rousseeuw and Leroy 1987, least median of squares).

        The middle lies above the median by the pairs that the parameters can explain whatever they are.
        """
        norms = self.linear.norms
        rank = min(int(0.5 * (len(norms) + self.used / 3.0)), len(norms) - 1)
        return max(float(np.partition(norms, rank)[rank]) / _MEDIAN_NORM, self.least_noise)

    def improve(self, weights: FloatArray, noise: float) -> float:
        """A Levenberg-Marquardt step; returns its length in units of what is left open (0: none was found)."""
        linear = self.linear
        roots = np.sqrt(weights) / (self.pairs.unit * noise)
        factor = linear.reduced(roots)
        design, target = factor[:, :-1], factor[:, -1]
        before = self._cost(roots)
        columns = np.einsum("ij,ij->j", design, design)
        self._measure(design)
        while self.damping <= _MOST_DAMPING:
            held = np.sqrt(1.0 + self.damping * columns)
            rows = np.concatenate([design, np.diag(held)])
            wanted = np.concatenate([target, -linear.offset / held])
            q, r = np.linalg.qr(rows)
            projected = q.T @ wanted
            step = cast(FloatArray, np.linalg.solve(r, projected))
            length = float(np.linalg.norm(projected))
            point = (linear.change, linear.residuals, linear.norms, linear.jacobian, linear.offset)
            linear.at(linear.moved(step))
            if self._cost(roots) <= before:
                self.damping = max(self.damping * 0.1, _LEAST_DAMPING)
                return length
            linear.change, linear.residuals, linear.norms, linear.jacobian, linear.offset = point
            if length < _SMALL_STEP:
                return 0.0
            self.damping = max(self.damping * 10.0, _FIRST_DAMPING)
        self.damping = _FIRST_DAMPING
        return 0.0

    def _cost(self, roots: FloatArray) -> float:
        residuals = np.einsum("ni,ni,n->", self.linear.residuals, self.linear.residuals, roots * roots)
        return float(residuals + self.linear.offset @ self.linear.offset)

    def _measure(self, design: FloatArray) -> None:
        """How many residual coordinates the parameters use up: Σ s² / (1 + s²) (MacKay 1992)."""
        squares = np.square(np.linalg.svd(design, compute_uv=False))
        self.used = float((squares / (1.0 + squares)).sum())


def fit_chain(parameters: ChainParameters, std: FloatArray, pairs: Pairs, start: FloatArray) -> RigidFit:
    """The most probable change for at least one pair, given the prior N(0, std²) on each parameter.

    Graduated non-convexity (Yang et al. 2020): Geman-McClure weights, and with them the noise that weighs data against
    prior, shrink from the largest residual to what is typical, so that neither outliers nor a marker far from its
    place stop the way. Then least squares on all pairs that are no outliers, with the noise estimated from them.
    """
    fitter = _Fitter(parameters, std, pairs, start)
    _anneal(fitter)
    return _polish(fitter)


def _anneal(fitter: _Fitter) -> None:
    scale = math.inf
    for _ in range(_ROUNDS):
        norms = fitter.linear.norms
        goal = _SCALES_PER_SIGMA * fitter.typical()
        scale = max(min(scale / 1.4, float(norms.max())), goal)
        step = fitter.improve((scale**2 / (scale**2 + norms**2)) ** 2, scale / _SCALES_PER_SIGMA)
        if scale == goal and (step < 1.0 or scale <= 2.0 * _SCALES_PER_SIGMA * fitter.least_noise):
            return


def _polish(fitter: _Fitter) -> RigidFit:
    pairs = fitter.pairs
    noise = fitter.typical()
    inliers = fitter.linear.norms <= _OUTLIER_SIGMAS * noise
    freedom = 0.0
    for _ in range(_ROUNDS):
        step = fitter.improve(inliers.astype(np.float64), noise)
        freedom = max(3.0 * float(inliers.sum()) - fitter.used, 0.0)
        square = float(np.square(fitter.linear.norms[inliers]).sum())
        estimate = _noise(square, freedom, pairs.known, fitter.least_noise)
        chosen = fitter.linear.norms <= _OUTLIER_SIGMAS * max(estimate, fitter.typical())
        settled = bool((chosen == inliers).all()) and abs(estimate - noise) <= 1e-3 * noise
        inliers, noise = chosen, estimate
        if settled and step < _SMALL_STEP * math.sqrt(1.0 + freedom):
            break
    return _summary(fitter, inliers, noise, freedom)


def _noise(square: float, freedom: float, known: bool, least: float) -> float:
    if not known:
        return max(math.sqrt(square / freedom), least) if freedom > 0.0 else least
    # Residuals by chance above what the known noise explains are no sign of a chain that does not fit.
    if square <= freedom + 2.0 * math.sqrt(2.0 * freedom):
        return 1.0
    return max(math.sqrt(square / freedom), 1.0)


def _summary(fitter: _Fitter, inliers: BoolArray, noise: float, freedom: float) -> RigidFit:
    linear, free, scales = fitter.linear, fitter.free, fitter.scales
    size = len(free)
    factor = linear.reduced(inliers / (fitter.pairs.unit * noise))
    _, singular, vt = np.linalg.svd(factor[:, :-1])
    singular = np.concatenate([singular, np.zeros(len(vt) - len(singular))])
    loose, rank = _undetermined(factor[:, :-1] / scales)
    spread = np.zeros((size, size))
    left = vt.T / np.sqrt(1.0 + np.square(singular))
    spread[np.ix_(free, free)] = scales[:, None] * left
    looseness = np.zeros(size)
    looseness[free] = loose
    square = float(np.square(linear.norms[inliers]).sum()) / noise**2 + float(linear.offset @ linear.offset)
    spans = 6.0 * float(np.log(noise * fitter.pairs.unit[inliers]).sum())
    evidence = -0.5 * (square + spans + 3.0 * float(inliers.sum()) * math.log(2.0 * math.pi))
    evidence -= 0.5 * float(np.log1p(np.square(singular)).sum())
    return RigidFit(linear.change, noise, freedom, inliers, spread, rank, looseness, evidence)


def _undetermined(design: FloatArray) -> tuple[FloatArray, int]:
    """How far each parameter lies in directions that no row shows, and how many directions the rows do show."""
    lengths = np.linalg.norm(design, axis=0)
    seen = lengths > 1e-12 * max(float(lengths.max(initial=0.0)), 1e-300)
    _, singular, vt = np.linalg.svd(design[:, seen] / lengths[seen])
    rank = int((singular > 1e-8 * singular.max(initial=0.0)).sum())
    loose = np.ones(design.shape[1])
    loose[seen] = np.linalg.norm(vt[rank:], axis=0)
    return loose, rank
