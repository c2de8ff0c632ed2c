"""Fit an ellipse to a ball's limb, with its uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .colour import Float32Array, Gate
from .contour import Limb, find_limb
from .contour_filters import USUAL_BLUR_PX
from .contour_spectrum import Waves, waves
from .normal import inverse_of_normal
from .polar import median

# Most iterations; converged when the limb and its blur changed by less than these [px].
_LOOKS, _SETTLED_PX, _SETTLED_BLUR_PX = 4, 0.02, 0.05
# An edge sharper than this after interpolation [px] was not anti-aliased: coverage is then the better measure.
_ALIASED_PX = 0.55
# Student's degrees of freedom of an edge's error, which set the weight of outliers; residual limit [px]; iterations.
_FREEDOM, _FARTHEST_PX, _ROUNDS = 4.0, 1.0, 3
# The wave once round is at least so large: this, and so many times the noise that the channels show; that the other
# waves are small is no sign that it is. Beside that it is this part of what the few waves tell, and where they tell of
# far more it is the square, over the last: a bend that shows is a sign of one that the fit has removed.
_LEAST_DENSITY, _NOISE, _TOLD, _USUAL_DENSITY = 0.5, 1.75, 0.4, 12.0
# If a smaller share of the rays carries the circle, their errors are not averaged out: sigma grows in proportion.
_LEAST_EVENNESS = 0.5
# What covers a ball breaks its limb at sharp corners, which shows in the quick waves; what is behind it bends whole
# arcs, in the slow ones, which the claim follows. Beyond so many times the variance of the samples, as far as the
# channels agree on that, it is no ball's limb alone.
_LARGEST_DENSITY = 10.0
# A larger deviation from the circle (RMS without noise, share of the radius, and of the blur) is angular: a square.
_MOST_ANGULAR, _MOST_ANGULAR_BLURS = 0.05, 0.25
# Smaller deviations (RMS, share of the radius) occur on every ball (seams, dust, dents) and are no occlusion.
_ROUND = 0.0075


@dataclass(frozen=True, slots=True)
class Circle:
    """Circle whose image under the ellipse's shape is the limb.

    Attributes:
        centre_px: shape (2,) [px].
        radius_px: [px].
        cov_px: covariance of the centre, shape (2, 2) [px²].
        radius_sigma_px: 1-sigma of the radius [px].
        unrest: deviation of the limb from the circle, in slow and quick waves, in variances of its samples; 0 if it is
            as round as usual.
        aliased: True if the image was not anti-aliased, so that the fit is unreliable.
    """

    centre_px: FloatArray
    radius_px: float
    cov_px: FloatArray
    radius_sigma_px: float
    unrest: float
    aliased: bool


@dataclass(frozen=True, slots=True)
class _Fit:
    """Result of one fit.

    Attributes:
        shift_px, growth_px: change of the circle's centre (2,) and radius [px].
        inverse: inverse normal matrix (3, 3) [px²].
        waves: waves of the residuals.
        pulls: influence of the rays on the circle, shape (n,), see `_pulls`.
        off_px: RMS residual without noise [px].
    """

    shift_px: FloatArray
    growth_px: float
    inverse: FloatArray
    waves: Waves
    pulls: FloatArray
    off_px: float


def fit_limb(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray
) -> Circle | None:
    """Fit an ellipse to the limb near the given outline, which must be right to about half a pixel.

    Return None if there is no ball's limb all around. If the iteration has not settled, its last step is added to the
    covariance.
    """
    blur_px = USUAL_BLUR_PX
    fit: _Fit | None = None
    unsettled, noise, excess, fewer = np.zeros(3), 1.0, 1.0, 1.0
    for _ in range(_LOOKS):
        limb = find_limb(image, gate, centre_px, radius_px, shape, blur_px)
        fit = None if limb is None else _fit(limb, radius_px)
        if limb is None or fit is None:
            return None
        centre_px, radius_px = centre_px + shape @ fit.shift_px, radius_px + fit.growth_px
        excess, fewer = limb.excess, max(1.0, _LEAST_EVENNESS / limb.evenness)
        noise = limb.noise_share * excess
        last_blur_px, blur_px = blur_px, limb.blur_px
        moved_px = max(float(np.linalg.norm(fit.shift_px)), abs(fit.growth_px))
        if moved_px < _SETTLED_PX and abs(blur_px - last_blur_px) < _SETTLED_BLUR_PX:
            unsettled = np.zeros(3)
            break
        unsettled = np.array([*fit.shift_px, fit.growth_px])
    aliased = blur_px < _ALIASED_PX
    if fit is None:
        return None
    is_angular = fit.off_px > max(_MOST_ANGULAR * radius_px, _MOST_ANGULAR_BLURS * blur_px)
    if (is_angular or fit.waves.quick > _LARGEST_DENSITY * excess) and not aliased:
        return None
    told = waves(fit.pulls, radius_px).mean
    usual = _LEAST_DENSITY + _NOISE * noise
    density = math.hypot(usual, (_TOLD + told / _USUAL_DENSITY) * told)
    cov = fewer**2 * density * fit.inverse + np.outer(unsettled, unsettled)
    # A blurred disc's edge, where it is steepest, is nearer to the centre than the disc's.
    radius_px += blur_px**2 / (2.0 * radius_px)
    is_round = fit.off_px < _ROUND * radius_px
    unrest = 0.0 if is_round else math.sqrt(fit.waves.slow * fit.waves.quick) / excess
    return Circle(centre_px, radius_px, shape @ cov[:2, :2] @ shape, math.sqrt(cov[2, 2]), unrest, aliased)


def _fit(limb: Limb, radius_px: float) -> _Fit | None:
    """Fit a circle by robust weighted least squares: outliers get low weight."""
    design, told = limb.rays, limb.weight > 0
    if np.count_nonzero(told) < len(told) // 2:
        return None
    weight = used = limb.weight
    solution: FloatArray = np.zeros(3)
    inverse: FloatArray | None = None
    residual = limb.offset_px
    for _ in range(_ROUNDS):
        used = weight
        inverse = inverse_of_normal((design * used[:, None]).T @ design)
        if inverse is None or np.count_nonzero(used) < len(told) // 2:
            return None
        solution = inverse @ (design.T @ (used * limb.offset_px))
        residual = limb.offset_px - design @ solution
        square = residual**2 * limb.weight
        usual = max(1.0, 1.4826**2 * median(square[told]))
        weight = np.where(np.abs(residual) < _FARTHEST_PX, limb.weight / (1.0 + square / usual / _FREEDOM), 0.0)
    if inverse is None:
        return None
    around = waves(np.sqrt(used) * residual, radius_px)
    pulls = _pulls(limb.weight, weight, residual)
    off = np.minimum(np.abs(residual[told]), _FARTHEST_PX)
    off_px = math.sqrt(max(0.0, float(np.mean(off**2 - 1.0 / limb.weight[told]))))
    return _Fit(solution[:2], float(solution[2]), inverse, around, pulls, off_px)


def _pulls(full: FloatArray, used: FloatArray, residual: FloatArray) -> FloatArray:
    """Return the influence (n,) of the rays on the circle as an M-estimate, in sigmas of `used`.

    Outliers have less weight, so the weighted residuals and the inverse normal matrix underestimate the uncertainty.
    With the weights' share f = 1/(1 + z²/ν) of a residual z the influence is z·f over the mean of its slope 2f² − f
    (Huber 1981, Robust Statistics, section 7.6).
    """
    share = np.divide(used, full, out=np.zeros_like(full), where=full > 0)
    told = np.count_nonzero(full)
    mean = float(share.sum()) / told
    slope = float(np.sum(2.0 * share**2 - share)) / told  # above 0, since half of the residuals are not far off
    return np.sqrt(full) * residual * share * (math.sqrt(mean) / slope)
