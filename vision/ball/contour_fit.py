"""Fit an ellipse to a ball's limb, with its uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .colour import Float32Array, Gate
from .contour import BallContour, find_contour
from .contour_spectrum import residual_spectrum
from .polar import fit_circle, median
from .settings import ContourSettings as _Settings


@dataclass(frozen=True, slots=True)
class Circle:
    """Circle whose image under the ellipse's shape is the limb."""

    centre_px: FloatArray  # shape (2,) [px]
    radius_px: float  # [px]
    cov_px: FloatArray  # covariance of the centre, shape (2, 2) [px²]
    radius_sigma_px: float  # 1-sigma of the radius [px]
    # deviation of the limb from the circle, in slow and quick waves, in variances of its samples; 0 if it is as round
    # as usual
    roughness: float
    blur_px: float  # blur of the edge (1-sigma) [px]

    @property
    def aliased(self) -> bool:
        """True if the image was not anti-aliased, so that the fit is unreliable."""
        return self.blur_px < _Settings.aliased_px


@dataclass(frozen=True, slots=True)
class _Fit:
    """Result of one fit."""

    solution: FloatArray  # change of the circle's centre and of its radius (3,) [px]
    inverse: FloatArray  # inverse normal matrix (3, 3) [px²]
    # used, weight: weights of the rays (n,) in this fit and in one that would follow [1/px²]
    used: FloatArray
    weight: FloatArray
    residual: FloatArray  # of the rays (n,) [px]


def fit_contour(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray, blur_px: float
) -> Circle | None:
    """Fit an ellipse to the limb near the given outline, which must be accurate to about half a pixel.

    It starts from the blur `blur_px`, and ends with the measured blur of the limb. Return None if there is no ball's
    limb all around. If the iteration has not settled, its last step is added to the covariance.
    """
    iterations = 0
    while True:
        contour = find_contour(image, gate, centre_px, radius_px, shape, blur_px)
        fit = None if contour is None else _fit(contour)
        if contour is None or fit is None:
            return None
        u, v, growth = fit.solution.tolist()
        centre_px, radius_px = centre_px + shape @ fit.solution[:2], radius_px + growth
        moved_px, widened_px = max(math.hypot(u, v), abs(growth)), contour.blur_px - blur_px
        blur_px, iterations = contour.blur_px, iterations + 1
        # If the image was not anti-aliased, the circle is not used.
        aliased = blur_px < _Settings.aliased_px
        settled = (aliased or moved_px < _Settings.settled_px) and abs(widened_px) < _Settings.settled_px
        if settled or iterations == _Settings.iterations:
            break
    excess, unevenness = contour.excess, max(1.0, _Settings.min_evenness / contour.evenness)
    spectrum, measured = residual_spectrum(np.sqrt(fit.used) * fit.residual, radius_px), contour.weight > 0
    deviations_px = np.minimum(np.abs(fit.residual[measured]), _Settings.farthest_px)
    rms_deviation_px = math.sqrt(
        max(0.0, float(np.mean(deviations_px**2 - 1.0 / contour.weight[measured])))
    )  # RMS without noise
    is_angular = rms_deviation_px > max(_Settings.max_angular * radius_px, _Settings.max_angular_blurs * blur_px)
    if (is_angular or spectrum.quick > _Settings.largest_density * excess) and not aliased:
        return None
    influence_power = residual_spectrum(_influences(contour.weight, fit.weight, fit.residual), radius_px).mean
    noise_density = _Settings.min_density + _Settings.channels_noise * contour.noise_share * excess
    density = math.hypot(
        noise_density, (_Settings.measured + influence_power / _Settings.usual_density) * influence_power
    )
    cov = unevenness**2 * density * fit.inverse
    if not settled:
        cov += np.outer(fit.solution, fit.solution)
    # A blurred disc's steepest edge is nearer to the centre than the disc's edge.
    radius_px += blur_px**2 / (2.0 * radius_px)
    is_round = rms_deviation_px < _Settings.round_share * radius_px
    roughness = 0.0 if is_round else math.sqrt(spectrum.slow * spectrum.quick) / excess
    return Circle(centre_px, radius_px, shape @ cov[:2, :2] @ shape, math.sqrt(cov[2, 2]), roughness, blur_px)


def _fit(contour: BallContour) -> _Fit | None:
    """Fit a circle by robust weighted least squares: outliers get low weight."""
    measured = contour.weight > 0
    weight, rounds = contour.weight, 0
    while True:
        fitted = None if np.count_nonzero(weight) < len(measured) // 2 else fit_circle(contour.offset_px, weight)
        if fitted is None:
            return None
        residual = contour.offset_px - contour.rays @ fitted[0]
        square, rounds, used = residual**2 * contour.weight, rounds + 1, weight
        scale = max(1.0, 1.4826**2 * median(square[measured]))
        weight = np.where(
            np.abs(residual) < _Settings.farthest_px, contour.weight / (1.0 + square / scale / _Settings.freedom), 0.0
        )
        if rounds == _Settings.rounds:
            return _Fit(*fitted, used, weight, residual)


def _influences(full: FloatArray, used: FloatArray, residual: FloatArray) -> FloatArray:
    """Return the influence (n,) of the rays on the circle as an M-estimate, in sigmas of `used`.

    Outliers have less weight, so the weighted residuals and the inverse normal matrix underestimate the uncertainty.
    With the weights' share f = 1/(1 + z²/ν) of a residual z the influence is z·f over the mean of its slope 2f² − f
    (Huber 1981, Robust Statistics, section 7.6).
    """
    share = np.divide(used, full, out=np.zeros_like(full), where=full > 0)
    measured = np.count_nonzero(full)
    mean = float(share.sum()) / measured
    slope = float(np.sum(2.0 * share**2 - share)) / measured  # positive, since half of the residuals are small
    return np.sqrt(full) * residual * share * (math.sqrt(mean) / slope)
