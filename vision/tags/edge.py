"""Measure the four straight edges of a tag's black square to hundredths of a pixel, with their uncertainty.

A matched filter on each line across the edge finds the transition from black to white. Each line has its own levels and
gradients on both sides, so uneven light and glare do not move the edge. The blur is estimated by a second filter. Two
errors are subtracted: the light that blur brings from the modules beyond and from the end of the paper, and the
apparent shift of an ideal edge of that blur on the same pixels.

All four edges are measured at once, in arrays that are padded to the longest edge and the widest reach.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from bodyschema.interfaces.records import FloatArray, ImageArray, Reason

from .settings import EdgeSettings as _Settings

# Black border, data and border of all dictionaries that are offered: 6 + 2 modules.
MODULES = 8.0
# Variance that interpolation between pixels adds to a blur [px²].
INTERPOLATION = 1.0 / 6.0
# Fourth cumulant along an axis of a square pixel and of the interpolation between them [px⁴]: no such blur reaches as
# far as a Gaussian.
PIXEL_CUMULANT = -1.0 / 40.0
# Corners as they go round, in parts of the side.
SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
# A tag's modules from those of the frame of each edge, in which the edge goes from (0, 0) to (8, 0).
_QUARTER = np.array([[0.0, -1.0, MODULES], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_TURNS = np.stack([np.linalg.matrix_power(_QUARTER, side) for side in range(4)])
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Edges:
    """The four lines u·normal = place + slope·s of a tag, s from −1 to 1 between the ends of an edge.

    Attributes:
        origins, along, normals: middles of the edges (4, 2) [px], and their directions along and outward.
        half_lengths, offsets, slopes: (4,) [px].
        scatter: covariance (4, 2, 2) of place and slope [px²] from the points' scatter, if they were independent.
        shared: covariance (4, 2, 2) of the error common to all points of an edge [px²].
        residuals: residuals of each edge's points in units of their scatter; 0 where a point was left out.
        widening: error of the assumed blur [px], multiplied by its information.
        information: inverse variance of the blur [1/px²], for a noise of one grey level.
        spots: two places on each edge (4, 2, 2) [px].
        levels: levels of black and white at the spots (4, 2, 2) [grey levels].
    """

    origins: FloatArray
    along: FloatArray
    normals: FloatArray
    half_lengths: FloatArray
    offsets: FloatArray
    slopes: FloatArray
    scatter: FloatArray
    shared: FloatArray
    residuals: tuple[FloatArray, ...]
    widening: float
    information: float
    spots: FloatArray
    levels: FloatArray

    @property
    def points(self) -> FloatArray:
        """The middle of each measured edge (4, 2) [px]."""
        return self.origins + self.offsets[:, None] * self.normals

    @property
    def directions(self) -> FloatArray:
        """From the middle of each measured edge to its end (4, 2) [px]."""
        return self.along * self.half_lengths[:, None] + self.slopes[:, None] * self.normals


@dataclass(frozen=True, slots=True)
class Light:
    """Light on a tag: planes through the levels of black and of white.

    Attributes:
        gradients: of black and white (2, 2) [grey levels/px].
        cov: covariance of each of the two gradients (2, 2, 2) [grey levels²/px²], from the residuals of the planes.
    """

    gradients: FloatArray
    cov: FloatArray


@dataclass(frozen=True, slots=True)
class _Rays:
    """Lines across the four edges, and the samples on them.

    Attributes:
        s: positions of the lines along their edge (4, n), from −1 to 1.
        used: mask (4, n) of the lines; the others are padding.
        counts: number of lines of each edge (4,).
        steps: positions of the samples along the lines (4, m) [px], outward.
        weights: 1 for samples (4, m), 0 for padding.
        spots: u and v (2, 4, n, m) [px] of the samples.
        ends: distance (4, 2, n) [px] to the inner end of the black border and the outer end of a white margin.
        beyond: u and v (2, 4, 2, n) [px] of the centres of the modules beyond these ends; none if corners are rough.
    """

    s: FloatArray
    used: Mask
    counts: NDArray[np.intp]
    steps: FloatArray
    weights: FloatArray
    spots: FloatArray
    ends: FloatArray
    beyond: FloatArray

    def mean(self, values: FloatArray) -> FloatArray:
        """Return the means (4,) of values (4, n) over the lines of each edge."""
        return np.asarray((values * self.used).sum(axis=1) / self.counts, np.float64)


@dataclass(frozen=True, slots=True)
class _Points:
    """Points of the edges on the lines across them.

    Attributes:
        offsets: position of the edge on each line, outward (4, n) [px], for the fit of the edge's place.
        slope_offsets: the same, for the fit of the edge's slope.
        has_contrast: mask (4, n) of the lines that show black and white.
        beyond_correction: correction for the modules beyond (4, n) [px].
        light_variance: variances (4, 2) of the fitted place and slope due to the uncertainty of the light [px²].
        widening, information, levels: see `Edges`.
    """

    offsets: FloatArray
    slope_offsets: FloatArray
    has_contrast: Mask
    beyond_correction: FloatArray
    light_variance: FloatArray
    widening: float
    information: float
    levels: FloatArray


def find_edges(
    grey: ImageArray, corners_px: FloatArray, blur_px: float, light: Light | None, length_share: float
) -> Edges | Reason:
    """Measure the edges from each corner to the next one, or return the reason why one cannot be measured.

    Args:
        light: None if the corners may be wrong by pixels.
        length_share: length of the lines across the edges, relative to the usual one.
    """
    begin, end = corners_px, corners_px[[1, 2, 3, 0]]
    lengths = np.linalg.norm(end - begin, axis=1)
    if lengths.min() < _Settings.min_points:
        return Reason.NO_MARKER
    along = (end - begin) / lengths[:, None]
    normals = np.column_stack([along[:, 1], -along[:, 0]])  # corners go round clockwise: out of the tag
    origins = (begin + end) / 2.0
    rays = _rays(corners_px, origins, along, normals, lengths, blur_px, length_share, rough=light is None)
    if isinstance(rays, Reason):
        return rays
    if touches_border(grey, rays.spots):
        return Reason.AT_BORDER
    profiles = sample_levels(grey, rays.spots)
    if light is None:
        points = _rough_points(profiles, rays, blur_px)
    else:
        axes = np.stack([0.5 * lengths[:, None] * along, normals], axis=2)
        light_variance = np.einsum("eiw,kij,ejw->ekw", axes, light.cov, axes)
        beyond = sample_levels(grey, _clamped(grey, rays.beyond))
        ideal = _ideal_levels(rays.spots, origins, normals, blur_px)
        cumulants = PIXEL_CUMULANT * (normals**4).sum(axis=1) / blur_px**4
        light_slopes = light.gradients @ axes
        points = _points(profiles, ideal, rays, beyond, blur_px, cumulants, light_slopes, light_variance)
    if isinstance(points, Reason):
        return points
    fitted = _fit_lines(rays, points)
    if isinstance(fitted, Reason):
        return fitted
    ends = np.stack([rays.s[:, 0], rays.s.max(axis=1)], axis=1)[..., None]
    spots = origins[:, None] + 0.5 * lengths[:, None, None] * ends * along[:, None]
    return Edges(
        origins, along, normals, 0.5 * lengths, *fitted, points.widening, points.information, spots, points.levels
    )


def _rays(
    corners_px: FloatArray,
    origins: FloatArray,
    along: FloatArray,
    normals: FloatArray,
    lengths: FloatArray,
    blur_px: float,
    length_share: float,
    *,
    rough: bool,
) -> _Rays | Reason:
    """Return the lines across the edges; the reason if an edge is too short for them."""
    to_px = np.asarray(cv2.getPerspectiveTransform(MODULES * SQUARE, corners_px.astype(np.float32)), np.float64)
    to_px = to_px @ _TURNS
    to_modules = np.asarray(np.linalg.inv(to_px), np.float64)
    quads = corners_px[(np.arange(4)[:, None] + np.arange(4)) % 4]
    modules = np.abs(_module_ends(to_modules, quads[:, :2].mT, normals)).min(axis=(1, 2))
    share = _Settings.clear_share * modules
    clear = np.minimum(np.maximum(modules - _Settings.clear_blurs * blur_px, share), _Settings.longest_reach_px)
    reaches = length_share * (np.maximum(clear, share) if rough else clear)
    # At an acute corner, nearby lines leave the tag through its other side.
    sides = quads[:, [3, 2]] - quads[:, :2]
    leaning = (sides * along[:, None]).sum(axis=2) / (sides * normals[:, None]).sum(axis=2)
    free = _Settings.corner_blurs * blur_px + np.maximum(leaning * np.outer(reaches, (-1.0, 1.0)), 0.0)
    counts = np.minimum((lengths - free.sum(axis=1)).astype(np.intp), _Settings.max_points)
    if counts.min() < _Settings.min_points:
        return Reason.NO_MARKER
    number = np.arange(counts.max())
    first, last = (2.0 * free / lengths[:, None] - 1.0).T * np.array([[1.0], [-1.0]])
    share = np.minimum(number / (counts[:, None] - 1.0), 1.0)
    s = first[:, None] + (last - first)[:, None] * share
    samples = 2 * np.ceil(reaches / _Settings.sample_px).astype(np.intp)[:, None]
    sample = np.arange(samples.max())
    steps = (np.minimum(sample, samples - 1) + 0.5) * (2.0 * reaches[:, None] / samples) - reaches[:, None]
    points = origins[..., None] + (0.5 * lengths[:, None] * along)[..., None] * s[:, None]
    ends = _module_ends(to_modules, points, normals)
    spots = points.swapaxes(0, 1)[..., None] + normals.T[..., None, None] * steps[:, None]
    module_ends = points[:, :, None] + ends[:, None] * normals[..., None, None]
    beyond = np.empty((2, 0)) if rough else _beyond(to_px, to_modules, module_ends)
    weights = (sample < samples).astype(np.float64)
    return _Rays(s, number < counts[:, None], counts, steps, weights, spots, ends, beyond)


def _module_ends(to_modules: FloatArray, points: FloatArray, normals: FloatArray) -> FloatArray:
    """Return the distances (4, 2, n) [px] along `normals` from points (4, 2, n) on the edges to two lines.

    They are the inner end of the black border and the outer end of a margin of one module.
    """
    depths = np.array([[1.0], [-1.0]])
    lines = to_modules[:, None, 1] - depths * to_modules[:, None, 2]  # (4, 2, 3)
    values = lines[..., :2] @ points + lines[..., 2:]
    return np.asarray(-values / (lines[..., :2] @ normals[..., None]), np.float64)


def _beyond(to_px: FloatArray, to_modules: FloatArray, places: FloatArray) -> FloatArray:
    """Return u and v (2, 4, 2, n) [px] of the centres of the modules beyond the ends of black border and margin.

    `places` (4, 2, 2, n) are u and v of both ends of each edge.
    """
    count = places.shape[3]
    row, weight = (to_modules[:, ::2, :2] @ places.reshape(4, 2, -1) + to_modules[:, ::2, 2:]).swapaxes(0, 1)
    columns = np.clip(row / weight, 0.5, MODULES - 0.5)
    depths = np.repeat([1.5, -1.5], count)
    centres = to_px[..., :1] * columns[:, None] + (to_px[..., 1:2] * depths + to_px[..., 2:])
    return np.asarray(centres[:, :2] / centres[:, 2:], dtype=np.float64).swapaxes(0, 1).reshape(2, 4, 2, count)


def touches_border(grey: ImageArray, places: FloatArray) -> bool:
    """Return True if some places, u and v (2, ...), are too near to the image's border to be sampled."""
    height, width = grey.shape
    return bool(places.min() < 1.0 or places[0].max() > width - 2.0 or places[1].max() > height - 2.0)


def _clamped(grey: ImageArray, places: FloatArray) -> FloatArray:
    """Return the places, u and v (2, ...), each clipped to the nearest one that can be sampled."""
    height, width = grey.shape
    return np.stack([np.clip(places[0], 1.0, width - 2.0), np.clip(places[1], 1.0, height - 2.0)])


def sample_levels(grey: ImageArray, places: FloatArray) -> FloatArray:
    """Return the grey levels at places, u and v (2, ...)."""
    # By hand: cv2.remap would round places to 1/32 px.
    whole = places.astype(np.intp)
    width = grey.shape[1]
    first = whole[1] * width + whole[0]
    pixels = np.ravel(grey)
    return _interpolated([pixels[first + more].astype(np.float64) for more in (0, 1, width, width + 1)], places - whole)


def _ideal_levels(places: FloatArray, origins: FloatArray, normals: FloatArray, blur_px: float) -> FloatArray:
    """Return the shares of white of edges through `origins` at places (2, 4, n, m), interpolated from pixels."""
    # Interpolation adds to the pixels' own blur.
    normals = normals / math.sqrt(max(blur_px**2, _Settings.sharpest_px**2) - INTERPOLATION)
    whole = np.floor(places)
    u, v = normals.T[:, :, None, None]
    level = whole[0] * u + whole[1] * v - (origins * normals).sum(axis=1)[:, None, None]
    return _interpolated([ndtr(level), ndtr(level + u), ndtr(level + v), ndtr(level + (u + v))], places - whole)


def _interpolated(pixels: list[FloatArray], parts: FloatArray) -> FloatArray:
    """Interpolate the values of four neighbouring pixels bilinearly at fractions of a pixel, u and v (2, ...)."""
    right, down = parts
    top = pixels[0] + (pixels[1] - pixels[0]) * right
    bottom = pixels[2] + (pixels[3] - pixels[2]) * right
    return np.asarray(top + (bottom - top) * down, np.float64)


def _rough_points(profiles: FloatArray, rays: _Rays, blur_px: float) -> _Points | Reason:
    """Return rough points from the share of black on each line (4, n, m); the edge may be anywhere on the lines."""
    samples = rays.weights.sum(axis=1)[:, None]
    plain = np.maximum(1.0, np.rint(0.5 * _Settings.plain * samples))
    number = np.arange(rays.weights.shape[1])
    ends = np.stack([number < plain, (number >= samples - plain) & (number < samples)], axis=1) / plain[..., None]
    black, white = np.einsum("enm,ekm,en->ke", profiles, ends, rays.used) / rays.counts
    if (white - black).min() < 0.5 * _Settings.min_contrast:
        return Reason.LOW_CONTRAST
    step = rays.steps[:, 1] - rays.steps[:, 0]
    shares = (white[:, None, None] - profiles) / (white - black)[:, None, None]
    lengths = step[:, None] * rays.weights
    places = (shares @ lengths[..., None])[..., 0] - 0.5 * step[:, None] * samples
    # The integral of share times rest is that of a Gaussian blur.
    blurs = math.sqrt(math.pi) * rays.mean(((shares * (1.0 - shares)) @ lengths[..., None])[..., 0])
    information = float(np.square(white - black) @ rays.counts)
    widening = (float(np.median(blurs)) - blur_px) * information
    nothing = np.zeros_like(places)
    return _Points(places, places, rays.used, nothing, np.zeros((4, 2)), widening, information, np.zeros((4, 2, 2)))


def _points(
    profiles: FloatArray,
    ideal: FloatArray,
    rays: _Rays,
    beyond: FloatArray,
    blur_px: float,
    cumulants: FloatArray,
    gradients: FloatArray,
    light_variance: FloatArray,
) -> _Points | Reason:
    """Return the edges' points on the lines across them, or the reason why there are none: too little contrast.

    Args:
        profiles: grey levels (4, n, m) on the lines.
        ideal: levels of an ideal edge at 0 there, 0 black and 1 white.
        beyond: grey levels (4, 2, n) beyond the ends of black border and margin.
        cumulants: fourth cumulant (4,) of the blur across each edge, in units of `blur_px`.
        gradients: change of black and white (4, 2, 2) per unit of s [grey levels] and of `steps` [grey levels/px].
        light_variance: variances of the gradients (4, 2, 2).
    """
    filters, steady, information = _filters(rays.steps, rays.weights, blur_px)
    s = rays.s[..., None]
    projection = _line_filters(rays.s, rays.used)

    def levels(at: FloatArray) -> FloatArray:
        # Light changes slowly along an edge.
        constant, slope = (projection @ (at @ filters[:, :2].mT)).transpose(1, 0, 2)[:, :, None]
        return np.asarray(constant + slope * s, np.float64)

    side = ndtr(rays.steps / blur_px)[:, None]
    light_shift = gradients[:, None, :, 0] * s
    slopes = gradients[:, None, :, 1:] * rays.steps[:, None, None]
    profiles = (
        profiles
        - (light_shift[..., :1] + slopes[:, :, 0]) * (1.0 - side)
        - (light_shift[..., 1:] + slopes[:, :, 1]) * side
    )
    black, white = np.moveaxis(levels(profiles), 2, 0)
    if rays.mean(white - black).min() < _Settings.min_contrast:
        return Reason.LOW_CONTRAST
    around = rays.steps[:, None]
    cumulant = cumulants[:, None, None]
    inner, outer = rays.ends.swapaxes(0, 1)[..., None]
    neighbours = (beyond[:, 0] - black)[..., None] * blurred_step((inner - around) / blur_px, cumulant)
    neighbours += (beyond[:, 1] - white)[..., None] * blurred_step((around - outer) / blur_px, cumulant)
    corrected = profiles - neighbours
    fitted = levels(corrected)
    contrast = fitted[..., 1] - fitted[..., 0]
    mean_contrast = rays.mean(contrast)[:, None]
    if mean_contrast.min() < _Settings.min_contrast:
        return Reason.LOW_CONTRAST
    contrast = np.maximum(contrast, 0.5 * mean_contrast)
    amplitudes = corrected @ filters.mT
    # Pixels shift and widen an ideal edge, too.
    shift, wider = np.moveaxis(amplitudes[..., 2:] / contrast[..., None] - ideal @ filters[:, 2:].mT, 2, 0)
    level = (
        rays.mean(amplitudes[..., 0])[:, None, None] * (1.0 - side)
        + rays.mean(amplitudes[..., 1])[:, None, None] * side
    )
    across = steady[..., None]
    slope_shift = ((corrected - level) @ across)[..., 0] / contrast - ((ideal - side) @ across)[..., 0]
    has_contrast = rays.used & (amplitudes[..., 1] - amplitudes[..., 0] > 0.5 * contrast)
    squared = np.square(contrast) * has_contrast * information[:, None]
    correction = -(neighbours @ filters[:, 2, :, None])[..., 0] / contrast
    # Both edges across a gradient move the same way: their errors add, which the factor accounts for.
    sides = np.concatenate([1.0 - side, side], axis=1)
    light_response = np.stack(
        [((sides * around) @ filters[:, 2, :, None])[..., 0], (sides @ across)[..., 0]], axis=2
    )  # (4, 2, 2)
    light_variances = 2.0 * (np.square(light_response / mean_contrast[..., None]) * light_variance[..., ::-1]).sum(
        axis=1
    )
    shown_levels = fitted + light_shift
    ends = np.stack([shown_levels[:, 0], shown_levels[np.arange(4), rays.counts - 1]], axis=1)
    return _Points(
        shift,
        slope_shift,
        has_contrast,
        correction,
        light_variances,
        float((wider * squared).sum()),
        float(squared.sum()),
        ends,
    )


def blurred_step(places: FloatArray, cumulant: float | FloatArray) -> FloatArray:
    """Return the levels of a step from 0 to 1 at 0, at positions in units of its blur.

    Edgeworth's series of a Gaussian blur and its fourth cumulant.
    """
    squares = places * places
    density = np.exp(-0.5 * squares) / math.sqrt(2.0 * math.pi)
    return np.asarray(ndtr(places) - cumulant / 24.0 * places * (squares - 3.0) * density, dtype=np.float64)


def _filters(steps: FloatArray, weights: FloatArray, blur_px: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return filters (4, 4, m) over samples at `steps` (4, m) [px], one more (4, m), and the blur's information (4,).

    The four filters give the levels of black and white at the edge, and the contrast times its shift and times the
    error of the blur. The additional filter gives the shift too, with a prior on the levels. All have a prior on the
    remainder of the light's gradients across the edge.

    An edge along the rows or columns has the same position within the pixels all along, so that the pixels' effect on
    its shape does not average out. Filters for the shift are wider than the edge: they hardly depend on that shape.
    """
    wide = math.hypot(blur_px, _Settings.wider_px)
    blurs = np.array([blur_px, wide, wide])[:, None, None]
    places = steps / blurs
    white, slope = ndtr(places), np.exp(-0.5 * places**2) / (blurs * math.sqrt(2.0 * math.pi))
    sides = np.stack([1.0 - white, white], axis=2)
    basis = np.concatenate([sides, np.stack([-slope, -slope * places], axis=2), sides * steps[:, None]], axis=2)
    basis *= weights[:, None]
    priors = 1.0 / np.array(
        [
            [level, level, np.inf, _Settings.free, _Settings.gradient, _Settings.gradient]
            for level in (_Settings.free, _Settings.free, _Settings.level)
        ]
    )
    cov = np.linalg.inv(basis @ basis.mT + (priors[:, :, None] * np.eye(6))[:, None])
    narrow, *shifts = cov[:, :, :4] @ basis
    free, steady = (-shift[:, 2] / (shift[:, 2] * slope[0]).sum(axis=1)[:, None] for shift in shifts)
    filters = np.stack([narrow[:, 0], narrow[:, 1], free, narrow[:, 3]], axis=1)
    return filters, np.asarray(steady, np.float64), np.asarray(1.0 / cov[0, :, 3, 3], np.float64)


def _line_filters(s: FloatArray, kept: Mask) -> FloatArray:
    """Return the filters (4, 2, n) for constant and slope of the line through values that are kept, at s (4, n)."""
    count, first, second = kept.sum(axis=1), (s * kept).sum(axis=1), (s * s * kept).sum(axis=1)
    scale = kept / (count * second - first**2)[:, None]
    return np.stack(
        [scale * (second[:, None] - first[:, None] * s), scale * (count[:, None] * s - first[:, None])], axis=1
    )


def _fit_lines(
    rays: _Rays, points: _Points
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, tuple[FloatArray, ...]] | Reason:
    """Fit lines through the points; return the reason if none can be fitted.

    The result is `offsets`, `slopes`, `scatter`, `shared` and `residuals`, see `Edges`.
    """
    kept = points.has_contrast
    needed = np.maximum(_Settings.min_visible * rays.counts, _Settings.min_points - 1)
    for _ in range(3):
        if (kept.sum(axis=1) < needed).any():
            return Reason.OCCLUDED
        line = _line_filters(rays.s, kept) @ points.slope_offsets[..., None]
        distance = np.abs(points.slope_offsets - line[:, 0] - line[:, 1] * rays.s)
        limit = np.maximum(_Settings.stray_medians * _medians(distance, kept), _Settings.wavy_px)
        inliers = points.has_contrast & (distance <= limit[:, None])
        if (inliers == kept).all():
            break
        kept = inliers
    filters = _line_filters(rays.s, kept)
    offset_pairs = np.stack([points.offsets, points.slope_offsets], axis=2)
    lines = filters @ offset_pairs  # (4, 2, 2)
    residuals = (offset_pairs - lines[:, None, 0] - lines[:, None, 1] * rays.s[..., None]) * kept[..., None]
    freedom = kept.sum(axis=1) - 2.0
    squares = np.maximum(np.square(residuals).sum(axis=1), freedom[:, None] * _Settings.floor_px**2)
    # With few points the scatter may be larger than estimated: this is the variance of Student's t.
    sigmas = np.sqrt(squares / np.maximum(freedom - 2.0, 1.0)[:, None])
    scatter = sigmas[:, :, None] * (filters @ filters.mT) * sigmas[:, None]
    beyond_correction = filters @ points.beyond_correction[..., None]
    floor = np.maximum(_Settings.floor_px**2 - scatter, 0.0) * np.eye(2)
    shared = (
        floor
        + _Settings.beyond_share**2 * beyond_correction @ beyond_correction.mT
        + points.light_variance[..., None] * np.eye(2)
    )
    normalised = residuals[..., 1] * np.sqrt(freedom / squares[:, 1])[:, None]
    return (
        lines[:, 0, 0],
        lines[:, 1, 1],
        scatter,
        shared,
        tuple(w[:k] for w, k in zip(normalised, rays.counts, strict=True)),
    )


def _medians(values: FloatArray, kept: Mask) -> FloatArray:
    """Return the medians (4,) of the values (4, n) that are kept."""
    ordered = np.sort(np.where(kept, values, np.inf), axis=1)
    count = kept.sum(axis=1)
    return 0.5 * (ordered[np.arange(4), (count - 1) // 2] + ordered[np.arange(4), count // 2])
