"""The exact place of a ball's outline: a blurred edge between a shaded ball and what is behind it, fitted to pixels.

`outline.py` finds the outline to a tenth of a pixel without a model of the edge. Here the image next to it is
described: along each ray the light is F(d)·Φ(−d/s) + B·(1 − Φ(−d/s)), where d is the distance from the edge, s the
width of the blur, B the background of that ray next to the edge, and F the ball's own light up to its limb. How far
each edge is from where it was expected follows by a matched filter, which is the step of Gauss and Newton towards the
most likely edge. It looks at the blur's width only, so that what stands farther off does not pull the centre.

F is that of a matt ball before one far light and an even one (Lambert's law); next to the limb its brightness falls as
a root of the distance, which no local extrapolation would find.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.special import ndtr

from interfaces.records import FloatArray

from .colour import Float32Array, Gate
from .rays import ball_colour, median, sample_rays

# Samples along a ray next to the edge: their distance, and how far they go in and out [px].
_STEP_PX = 0.5
_INSIDE_PX, _OUTSIDE_PX = 2.5, 5.0
# The background is told beyond the blur, from a strip of this width [px].
_CLEAR_PX, _CLEAR_WIDTHS, _STRIP_PX = 1.5, 2.0, 3.0
# Blurs that are tried (1-sigma) [px], on the samples this near to the edge [px].
_WIDTHS_PX = np.linspace(0.35, 2.2, 38)
_WIDTH_REACH_PX = 2.6
# The ball's shading is told from rings between these: part of the radius, and so far inside the edge [px].
_SHADING_RINGS, _SHADING_FROM, _SHADING_CLEAR_PX = 7, 0.2, 1.2
_SHADING_PASSES = 3
# Waves round the outline in which the ball's light may differ from that of a matt one.
_MISFIT_WAVES = 3
# Rays with less than this part of the usual contrast tell nothing about the blur.
_USUAL_CONTRAST = 0.4
# White noise of the pixels makes cubically interpolated samples on average this much less noisy (1-sigma).
_INTERPOLATED_NOISE = 0.80


@dataclass(frozen=True, slots=True)
class EdgePoints:
    """The edge on each of n rays around a rough centre, in the frame in which the outline is a circle.

    Attributes:
        distance_px: distance of the edge from the rough centre, shape (n,) [px].
        sigma_px: 1-sigma of `distance_px` by noise and uneven background, shape (n,) [px].
        shading_px: how far each edge was moved because the ball's light is not quite a matt ball's, shape (n,) [px].
        width_px: the blur across the edge (1-sigma) [px].
    """

    distance_px: FloatArray
    sigma_px: FloatArray
    shading_px: FloatArray
    width_px: float


def find_edge_points(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray, angles: FloatArray
) -> EdgePoints | None:
    """The edge along rays at `angles` (n,) [rad] around an outline known to a fifth of a pixel; None without a ball.

    Args:
        image: BGR, shape (height, width, 3), grey levels.
        centre_px, radius_px: the outline's centre (2,) and radius, in the pixel coordinates of `image` [px].
        shape: the ellipse's shape (2, 2), see `sphere.Ellipse`.
    """
    rings = np.linspace(_SHADING_FROM * radius_px, radius_px - min(_SHADING_CLEAR_PX, 0.3 * radius_px), _SHADING_RINGS)
    at = np.arange(-min(_INSIDE_PX, 0.5 * radius_px), _OUTSIDE_PX + _STEP_PX / 2, _STEP_PX)
    radii = np.concatenate([rings, radius_px + at])
    samples = sample_rays(image, centre_px, angles, radii, shape, cv2.INTER_CUBIC)
    inside, profile = samples[:, :_SHADING_RINGS], samples[:, _SHADING_RINGS:]
    colour = ball_colour(inside, gate)
    if colour is None:
        return None
    width = _width(profile, at)
    strip = _strip(at, width)
    background = profile[:, strip].mean(axis=1)
    scatter = profile[:, strip].std(axis=1).mean(axis=1)
    amount = _without_background(gate.amount(inside), gate.amount(background), rings - radius_px, width)
    level = _shaded(angles, rings / radius_px, amount, 1.0 - _depth_inside(at, width) / radius_px)

    limb = int(np.argmin(np.abs(at)))
    apart = level[:, limb, None] * colour - background
    contrast = np.sqrt(np.einsum("nc,nc->n", apart, apart)) + 1.0
    towards = apart / contrast[:, None]
    seen = np.matmul(profile, towards[:, :, None])[..., 0]
    ball = level * (towards @ colour)[:, None]
    slope_behind = _slope(seen[:, at >= at[strip][0]], at[at >= at[strip][0]], angles)
    beyond = _depth_inside(-at, width) - at[strip].mean()
    behind = np.einsum("nc,nc->n", towards, background)[:, None] + slope_behind[:, None] * beyond
    share = ndtr(-at / width)
    slope = np.exp(-0.5 * (at / width) ** 2) / (np.sqrt(2 * np.pi) * width)
    unlike = seen - ball * share - behind * (1.0 - share)
    clear = at <= -_SHADING_CLEAR_PX
    # In grey levels: next to a background of the ball's own colour a part of the contrast would say nothing.
    misfit = _slow(unlike[:, clear].mean(axis=1) / share[clear].mean(), angles)
    shading = (slope @ share / (slope @ slope)) * misfit / contrast
    shift = unlike @ slope / (contrast * (slope @ slope)) - shading
    sigma = _sigma(contrast, scatter, share, slope, int(np.count_nonzero(strip)), 2 * np.pi * radius_px / len(angles))
    return EdgePoints(radius_px + shift, sigma, shading, width)


def _width(profile: Float32Array, at: FloatArray) -> float:
    """The blur (1-sigma) [px] that makes the usual profile across the edge; shape (n, m, 3) at distances (m,)."""
    ball, background = profile[:, 0], profile[:, _strip(at, _WIDTHS_PX[0])].mean(axis=1)
    apart = ball - background
    contrast = np.einsum("nc,nc->n", apart, apart)
    clear = contrast > _USUAL_CONTRAST**2 * median(contrast)
    share = np.matmul(profile[clear] - background[clear, None], apart[clear, :, None])[..., 0] / contrast[clear, None]
    near = np.abs(at) < _WIDTH_REACH_PX
    usual = np.partition(share[:, near], len(share) // 2, axis=0)[len(share) // 2]
    models = _edges_of_all_widths(tuple(at[near].tolist()))
    scale = (models @ usual) / np.einsum("wm,wm->w", models, models)
    return float(_WIDTHS_PX[np.argmin(((usual - scale[:, None] * models) ** 2).sum(axis=1))])


@lru_cache(maxsize=16)
def _edges_of_all_widths(at: tuple[float, ...]) -> FloatArray:
    return np.asarray(ndtr(-np.array(at) / _WIDTHS_PX[:, None]))


def _strip(at: FloatArray, width: float) -> np.ndarray:
    """Which samples show the background next to the edge."""
    first = min(max(_CLEAR_PX, _CLEAR_WIDTHS * width), _OUTSIDE_PX - _STRIP_PX)
    return (at >= first) & (at <= first + _STRIP_PX)


def _without_background(amount: FloatArray, background: FloatArray, at: FloatArray, width: float) -> FloatArray:
    """The ball's own amount of colour (n, rings) where the blur mixes in some background (n,)."""
    share = ndtr(-at / width)
    return (amount - background[:, None] * (1.0 - share)) / share


def _depth_inside(at: FloatArray, width: float) -> FloatArray:
    """Mean distance [px] inside the edge of the ball's light that a blurred image shows at distance `at`."""
    z = -at / width
    # Mean of a normal distribution cut off at 0; far outside it falls as the blur's width.
    mean = np.exp(-0.5 * z * z) / (np.sqrt(2 * np.pi) * np.maximum(ndtr(z), 1e-5)) + z
    return width * np.where(z > -4.0, mean, 0.2)


def _shaded(angles: FloatArray, rho: FloatArray, amount: FloatArray, wanted: FloatArray) -> FloatArray:
    """The light of a matt ball fitted to `amount` (n, rings) at radii `rho`, at the radii `wanted` (m,): (n, m).

    Both radii are parts of the ball's. Light: even + max(0, normal · far).
    """
    normals = _normals(angles, rho).reshape(-1, 3)
    values = amount.reshape(-1)
    area = np.tile(rho, len(angles))
    weight, design = area, np.concatenate([np.ones((len(normals), 1)), normals], axis=1)
    light = np.zeros(4)
    for _ in range(_SHADING_PASSES):
        weighted = design * weight[:, None]
        normal = weighted.T @ design
        normal[np.diag_indices(4)] += 1e-4 * len(values)
        light = np.linalg.solve(normal, weighted.T @ values)
        off = np.abs(values - design @ light)
        weight = area / (1.0 + (off / (3.0 * median(off) + 1.0)) ** 2)
        design[:, 1:] = normals * (normals @ light[1:] > 0)[:, None]
    return np.maximum(light[0] + np.maximum(_normals(angles, np.clip(wanted, 0.0, 1.0)) @ light[1:], 0.0), 0.0)


def _slope(seen: FloatArray, at: FloatArray, angles: FloatArray) -> FloatArray:
    """How steeply the background (n, m) rises along each ray (n,) [1/px], as far as it does so in the slowest waves."""
    lever = (at - at.mean()) / np.sum((at - at.mean()) ** 2)
    return _slow(seen @ lever, angles)


def _slow(values: FloatArray, angles: FloatArray) -> FloatArray:
    """The mean and the slowest waves of `values` (n,) round the outline, less what noise alone would make of them.

    James and Stein's estimator: where `values` are noise, nearly nothing is left; waves well above it stay.
    """
    middle = median(values)
    spread = 3.0 * 1.4826 * median(np.abs(values - middle))
    clipped = np.clip(values, middle - spread, middle + spread)
    waves = np.exp(1j * np.arange(1, _MISFIT_WAVES + 1)[:, None] * angles)
    slow = clipped.mean() + 2.0 / len(values) * np.real((waves.conj() @ clipped) @ waves)
    off = clipped - slow
    by_noise = (2 * _MISFIT_WAVES + 1) / len(values) * float(off @ off)
    return slow * max(0.0, 1.0 - by_noise / max(float(slow @ slow), 1e-9))


def _normals(angles: FloatArray, rho: FloatArray) -> FloatArray:
    """Surface normals (n, m, 3) of a ball, the third towards the eye."""
    z = np.broadcast_to(np.sqrt(1.0 - rho**2), (len(angles), len(rho)))
    return np.stack([np.cos(angles)[:, None] * rho, np.sin(angles)[:, None] * rho, z], axis=-1)


def _sigma(
    contrast: FloatArray, scatter: FloatArray, share: FloatArray, slope: FloatArray, strip: int, arc_px: float
) -> FloatArray:
    """1-sigma of each edge (n,) [px]: the pixels' noise, that of the background's mean, and its unevenness."""
    usual = median(scatter)
    density = (usual / _INTERPOLATED_NOISE) ** 2 / (arc_px * _STEP_PX)
    by_background = slope @ (1.0 - share) / (slope @ slope)
    noise = density * (1.0 / (slope @ slope) + by_background**2 / strip)
    uneven = np.maximum(scatter**2 - (1.5 * usual) ** 2, 0.0)
    return np.sqrt(noise + by_background**2 * uneven) / contrast
