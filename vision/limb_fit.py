"""The ellipse through a ball's limb, and how sure it is.

Errors of the edge are not independent from ray to ray: neighbours share pixels and background. A shift of the centre is
the wave that goes once round the outline. The fit has removed it, and the next ones tell its size.
"""

from __future__ import annotations

import numpy as np

from interfaces.records import FloatArray

from .colour import Float32Array, Gate
from .limb import Limb, find_limb
from .limb_filters import USUAL_BLUR_PX
from .polar import median

# The limb is looked for so often at most, and is found when a look moved it and its blur less than this [px].
_LOOKS, _SETTLED_PX, _SETTLED_BLUR_PX = 4, 0.02, 0.05
# Blurs that are looked for [px].
_SHARPEST_PX, _WIDEST_PX = 0.45, 3.0
# Student's degrees of freedom of an edge's error: how little what is far off counts. Beyond this nothing counts [px].
_FREEDOM, _FARTHEST_PX, _ROUNDS = 4.0, 1.0, 3
# A ray's samples share pixels with each other and with its neighbours': variance of even backgrounds, that the filters
# take for 1; and how many waves that knowledge is worth.
_SHARED_PIXELS, _WORTH = 1.7, 2.0
# The waves that tell the covariance go up to this one, or up to radius / _WAVE_RADIUS_PX if that is more.
_LEAST_WAVES, _WAVE_RADIUS_PX = 4, 3.0
# Lens and interpolation smooth along the outline too, which takes power from the quicker waves (1-sigma) [px].
_SMOOTHING_PX = 1.0


def fit_limb(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray
) -> tuple[FloatArray, float, FloatArray] | None:
    """Centre (2,) [px], radius [px] and covariance of the centre (2, 2) [px²] of the ellipse through the limb.

    None when nothing like a ball's limb is near the outline given, which is right to half a pixel or so.
    """
    blur_px, cov_px = USUAL_BLUR_PX, np.eye(2)
    for _ in range(_LOOKS):
        limb = find_limb(image, gate, centre_px, radius_px, shape, blur_px)
        fitted = None if limb is None else _fit(limb, radius_px)
        if limb is None or fitted is None:
            return None
        (*shift, wider), cov_px = fitted
        centre_px, radius_px = centre_px + shape @ np.array(shift), radius_px + wider
        last_blur_px, blur_px = blur_px, min(max(limb.blur_px, _SHARPEST_PX), _WIDEST_PX)
        if max(np.hypot(*shift), abs(wider)) < _SETTLED_PX and abs(blur_px - last_blur_px) < _SETTLED_BLUR_PX:
            break
    # A blurred disc's edge, where it is steepest, is nearer to the centre than the disc's.
    return centre_px, radius_px + blur_px**2 / (2.0 * radius_px), shape @ cov_px @ shape


def _fit(limb: Limb, radius_px: float) -> tuple[FloatArray, FloatArray] | None:
    """Shift (2,) and growth of the circle [px], shape (3,), and the shift's covariance (2, 2) [px²]."""
    design = np.stack([np.cos(limb.angles), np.sin(limb.angles), np.ones_like(limb.angles)], axis=1)
    told = limb.weight > 0
    if np.count_nonzero(told) < len(told) // 2:
        return None
    used, solution, residual, normal = limb.weight, np.zeros(3), limb.offset_px, np.eye(3)
    weight = used
    for _ in range(_ROUNDS):
        used = weight
        normal = (design * used[:, None]).T @ design
        if not np.count_nonzero(used) > len(told) // 2 or np.linalg.cond(normal) > 1e5:
            return None
        solution = np.linalg.solve(normal, design.T @ (used * limb.offset_px))
        residual = limb.offset_px - design @ solution
        square = residual**2 * limb.weight
        usual = max(1.0, 1.4826**2 * median(square[told]))
        weight = np.where(np.abs(residual) < _FARTHEST_PX, limb.weight / (1.0 + square / usual / _FREEDOM), 0.0)
    density = _noise_density(limb.angles, np.sqrt(used) * residual, radius_px)
    return solution, density * np.linalg.inv(normal)[:2, :2]


def _noise_density(angles: FloatArray, residual: FloatArray, radius_px: float) -> float:
    """Variance of the residuals (n,), in units of their own, in the wave that goes once round the outline.

    Pixel noise gives all waves the same power; what is behind the ball disturbs whole arcs and makes the slow ones
    larger. So their excess over the quick ones counts once more.
    """
    last_slow = max(_LEAST_WAVES, round(radius_px / _WAVE_RADIUS_PX))
    last_quick = max(last_slow + 1, min(2 * last_slow, round(radius_px)))
    harmonics = np.arange(2, last_quick + 1)
    waves = np.exp(-1j * harmonics[:, None] * angles) @ residual
    power = np.abs(waves) ** 2 * np.exp((harmonics * _SMOOTHING_PX / radius_px) ** 2) / np.count_nonzero(residual)
    is_slow = harmonics <= last_slow
    share = harmonics[is_slow] ** -2.0 / np.sum(harmonics[is_slow] ** -2.0)
    slow, quick = float(share @ power[is_slow]), float(np.mean(power[~is_slow]))
    seen = slow + max(0.0, slow - quick)
    # Student's t with two degrees of freedom per wave: 1-sigma of a spread that is itself estimated.
    student = 1.0 + 0.25 * float(share @ share)
    # What the waves show less than the pixels' noise alone makes is chance.
    waves_seen = 1.0 / float(share @ share)
    return student**2 * max(seen, (waves_seen * seen + _WORTH * _SHARED_PIXELS) / (waves_seen + _WORTH))
