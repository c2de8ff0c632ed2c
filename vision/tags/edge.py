"""Measure one straight edge of a tag's black square to hundredths of a pixel, with its uncertainty.

A matched filter on each line across the edge finds where black becomes white. Each line has levels and gradients of its
own on both sides, so uneven light and glare move no edge. The blur is estimated by a second filter. Two errors are
subtracted: the light that blur brings from the modules beyond and from the end of the paper, and the apparent shift of
an ideal edge of that blur on the same pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from bodyschema.interfaces.records import FloatArray, ImageArray, Reason

from .config import TagConfig

# Black border, data and border of all dictionaries that are offered: 6 + 2 modules.
MODULES = 8.0
# Distance that lines across an edge keep from the ends of black border and white margin (one module each): so many
# blurs, so that little of the modules beyond shows; on small tags they reach over this share of the module.
_CLEAR_BLURS, _CLEAR_SHARE = 1.7, 0.5
LONGEST_REACH_PX, _SHORTEST_REACH_PX = 6.0, 0.6
_SAMPLE_PX = 0.5
# Distance from the corners, whose blur rounds the edges off: blurs, and share of the side; at most this share.
_CORNER_BLURS, _CORNER_SHARE, _MOST_CORNER = 2.6, 0.08, 0.25
_FEWEST_POINTS, _MOST_POINTS = 6, 80
# The sharpest edge (1-sigma) [px].
SHARPEST_PX = 0.45
# Variance that interpolation between pixels adds to a blur [px²].
_INTERPOLATION = 1.0 / 6.0
# Fourth cumulant along an axis of a square pixel and of the interpolation between them [px⁴]: no such blur reaches as
# far as a Gaussian.
PIXEL_CUMULANT = -1.0 / 40.0
# Relative error of the correction for the modules beyond: no lens blurs exactly like a Gaussian.
_BEYOND_SHARE = 0.2
# Systematic error of an edge's position on long lines [px]; larger on short ones.
_FLOOR_PX = 0.002
# Points farther from their line than this, in robust standard deviations, are outliers.
_STRAY = 3.5
_MAD_TO_SIGMA = 1.4826
# What is added to the blur of the filter for an edge's shift [px].
_WIDER_PX = 1.5
# Prior variances in units of the noise: of the levels, and of their gradients across the edge [1/px²].
_FREE, _LEVEL, _GRADIENT = 1e4, 0.5, 0.01
# Ends of the lines across that show plain black and plain white where an edge may be pixels off, as a share of their
# reach.
_PLAIN = 0.35
Pixels = NDArray[np.intp]
# Corners as they go round, in parts of the side.
_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


@dataclass(frozen=True, slots=True)
class Edge:
    """A line u·normal = place + slope·s, s from −1 to 1 between the edge's ends.

    Attributes:
        scatter: covariance (2, 2) of place and slope [px²] from the points' scatter, if they were independent.
        shared: covariance (2, 2) of the error common to all points [px²].
        residuals: residuals of the points (n,) in units of their scatter; 0 where a point was left out.
        widening: error of the assumed blur [px] times its information,
        information: inverse of its variance [1/px²], for a noise of one grey level.
        places: two places (2, 2) on the edge [px], whose
        levels: levels of black and white are these (2, 2) [grey levels].
    """

    origin: FloatArray
    along: FloatArray
    normal: FloatArray
    half_length: float
    place: float
    slope: float
    scatter: FloatArray
    shared: FloatArray
    residuals: FloatArray
    widening: float
    information: float
    places: FloatArray
    levels: FloatArray

    @property
    def point(self) -> FloatArray:
        return self.origin + self.place * self.normal

    @property
    def direction(self) -> FloatArray:
        return self.along * self.half_length + self.slope * self.normal


@dataclass(frozen=True, slots=True)
class Light:
    """Light on a tag: planes through the levels of black and of white.

    Attributes:
        gradients: of black and white (2, 2) [grey levels/px].
        cov: of each of the two gradients (2, 2, 2) [grey levels²/px²], from what the planes leave.
    """

    gradients: FloatArray
    cov: FloatArray


@dataclass(frozen=True, slots=True)
class _Points:
    """Points of an edge on the lines across it.

    Attributes:
        places: position of the edge on each line, outward (n,) [px], as the place of all together needs it,
        steady: the same, as their slope needs it.
        clear: mask (n,) of the lines that show black and white.
        beyond: correction for the modules beyond (n,) [px].
        unlit: variances (2,) of place and slope of all together that the light's uncertainty leaves [px²].
        widening, information, levels: see `Edge`.
    """

    places: FloatArray
    steady: FloatArray
    clear: NDArray[np.bool_]
    beyond: FloatArray
    unlit: FloatArray
    widening: float
    information: float
    levels: FloatArray


def find_edge(
    grey: ImageArray, corners_px: FloatArray, side: int, blur_px: float, light: Light | None, config: TagConfig
) -> Edge | Reason:
    """Measure the edge from corner `side` to the next one, or return the reason why it cannot be measured.

    `light` is None if the corners may be wrong by pixels.
    """
    quad = np.roll(corners_px, -side, axis=0)
    begin, end = quad[:2]
    length = float(np.linalg.norm(end - begin))
    if length < _FEWEST_POINTS:
        return Reason.NO_MARKER
    along = (end - begin) / length
    normal = np.array([along[1], -along[0]])  # corners go round clockwise: out of the tag
    to_px = np.asarray(cv2.getPerspectiveTransform(MODULES * _SQUARE, quad.astype(np.float32)), np.float64)
    module = float(np.abs(_module_ends(to_px, quad[:2], normal)).min())
    reach = min(max(module - _CLEAR_BLURS * blur_px, _CLEAR_SHARE * module), LONGEST_REACH_PX)
    if not reach >= _SHORTEST_REACH_PX:
        return Reason.NO_MARKER
    # At an acute corner, nearby lines leave the tag through its other side.
    sides = quad[[3, 2]] - quad[:2]
    leaning = (sides @ along) / (sides @ normal) * (-reach, reach)
    rounded = min(max(_CORNER_BLURS * blur_px, _CORNER_SHARE * length), _MOST_CORNER * length)
    free = rounded + np.maximum(leaning, 0.0)
    count = min(int(length - free.sum()), _MOST_POINTS)
    if count < _FEWEST_POINTS:
        return Reason.NO_MARKER
    s = np.linspace(2.0 * free[0] / length - 1.0, 1.0 - 2.0 * free[1] / length, count)
    origin = (begin + end) / 2.0
    points = origin + 0.5 * length * s[:, None] * along
    ends = _module_ends(to_px, points, normal)
    steps = _steps(reach)
    places = points[:, None] + steps[:, None] * normal
    if _leave(grey, places):
        return Reason.AT_BORDER
    beyond = _sampled(grey, _within(grey, _beyond(to_px, points[:, None] + ends[..., None] * normal)))
    ideal = _ideal(places, origin, normal, blur_px)
    if light is None:
        rough = _rough_points(_sampled(grey, places), steps, config.min_contrast)
        line = rough if isinstance(rough, Reason) else _line(s, rough, config)
        if isinstance(line, Reason):
            return line
        return Edge(origin, along, normal, 0.5 * length, *line, 0.0, 0.0, points[[0, -1]], np.zeros((2, 2)))
    ways = np.column_stack([0.5 * length * along, normal])
    gradients, unlit = light.gradients @ ways, np.einsum("iw,kij,jw->kw", ways, light.cov, ways)
    profiles = _sampled(grey, places)
    cumulant = PIXEL_CUMULANT * float((normal**4).sum()) / blur_px**4
    found = _points(profiles, ideal, s, steps, beyond, ends, blur_px, cumulant, gradients, unlit, config.min_contrast)
    if isinstance(found, Reason):
        return found
    line = _line(s, found, config)
    if isinstance(line, Reason):
        return line
    return Edge(
        origin, along, normal, 0.5 * length, *line, found.widening, found.information, points[[0, -1]], found.levels
    )


def _module_ends(to_px: FloatArray, points: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the distances (n, 2) [px] along `normal` from points (n, 2) of a tag's first edge to two lines.

    They are the inner end of the black border and the outer end of a margin of one module.

    `to_px` (3, 3) is the homography from modules, the edge from (0, 0) to (8, 0), to pixels.
    """
    ends = np.zeros((len(points), 2))
    for number, depth in enumerate((1.0, -1.0)):
        first, last = (to_px @ (column, depth, 1.0) for column in (0.0, MODULES))
        line = np.cross(first, last)
        ends[:, number] = -(points @ line[:2] + line[2]) / (normal @ line[:2])
    return ends


def _beyond(to_px: FloatArray, places: FloatArray) -> FloatArray:
    """Return the centres (n, 2, 2) [px] of the modules beyond the ends (n, 2, 2) [px] of black border and margin."""
    homogeneous = np.concatenate([places, np.ones((*places.shape[:2], 1))], axis=2)
    modules = homogeneous @ np.linalg.inv(to_px).T
    columns = np.clip(modules[..., 0] / modules[..., 2], 0.5, MODULES - 0.5)
    there = np.stack([columns, np.broadcast_to([1.5, -1.5], columns.shape), np.ones_like(columns)], axis=2) @ to_px.T
    return np.asarray(there[..., :2] / there[..., 2:], dtype=np.float64)


def _steps(reach: float) -> FloatArray:
    """Return the sample positions along a line across an edge, shape (m,) [px], outward."""
    count = 2 * math.ceil(reach / _SAMPLE_PX)
    return np.asarray((np.arange(count) + 0.5) * (2.0 * reach / count) - reach, dtype=np.float64)


def _leave(grey: ImageArray, places: FloatArray) -> bool:
    """Return True if some places (..., 2) are too near to the image's border to be sampled."""
    height, width = grey.shape
    return bool((places < 1.0).any() or (places > (width - 2.0, height - 2.0)).any())


def _within(grey: ImageArray, places: FloatArray) -> FloatArray:
    """Return the places (..., 2), each moved to the nearest one that can be sampled."""
    height, width = grey.shape
    return np.clip(places, 1.0, (width - 2.0, height - 2.0))


def _sampled(grey: ImageArray, places: FloatArray) -> FloatArray:
    """Return the grey levels at places (..., 2)."""
    # By hand: cv2.remap would round places to 1/32 px.
    return _interpolated(lambda u, v: grey[v, u].astype(np.float64), places)


def _ideal(places: FloatArray, origin: FloatArray, normal: FloatArray, blur_px: float) -> FloatArray:
    """Return the shares of white of an edge through `origin` (2,) at places (..., 2), interpolated from pixels."""
    # Interpolation adds to the pixels' own blur.
    sigma = math.sqrt(max(blur_px**2 - _INTERPOLATION, SHARPEST_PX**2 - _INTERPOLATION))
    first = float(origin @ normal)
    return _interpolated(lambda u, v: ndtr((u * normal[0] + v * normal[1] - first) / sigma), places)


def _interpolated(pixel: Callable[[Pixels, Pixels], FloatArray], places: FloatArray) -> FloatArray:
    """Interpolate bilinearly at places (..., 2), given the values at columns and rows."""
    whole = np.floor(places).astype(np.intp)
    part = places - whole
    u, v = whole[..., 0], whole[..., 1]
    top = pixel(u, v) * (1.0 - part[..., 0]) + pixel(u + 1, v) * part[..., 0]
    bottom = pixel(u, v + 1) * (1.0 - part[..., 0]) + pixel(u + 1, v + 1) * part[..., 0]
    return top * (1.0 - part[..., 1]) + bottom * part[..., 1]


def _rough_points(profiles: FloatArray, steps: FloatArray, min_contrast: float) -> _Points | Reason:
    """Return an edge's points from the share of black on each line (n, m): rough, but from anywhere on the lines."""
    plain = max(1, round(_PLAIN * len(steps) / 2.0))
    black, white = float(profiles[:, :plain].mean()), float(profiles[:, -plain:].mean())
    if white - black < 0.5 * min_contrast:
        return Reason.LOW_CONTRAST
    step = float(steps[1] - steps[0])
    places = ((white - profiles) / (white - black)).sum(axis=1) * step - 0.5 * step * len(steps)
    all_clear, nothing = np.ones(len(places), dtype=bool), np.zeros(len(places))
    return _Points(places, places, all_clear, nothing, np.zeros(2), 0.0, 0.0, np.zeros((2, 2)))


def _points(
    profiles: FloatArray,
    ideal: FloatArray,
    s: FloatArray,
    steps: FloatArray,
    beyond: FloatArray,
    ends: FloatArray,
    blur_px: float,
    cumulant: float,
    gradients: FloatArray,
    unlit: FloatArray,
    min_contrast: float,
) -> _Points | Reason:
    """Return the edge's points on the lines across it, or the reason why there are none: too little contrast.

    Args:
        profiles: grey levels (n, m) at s (n,) along the edge and `steps` (m,) [px] across it.
        ideal: levels of an ideal edge at 0 there, 0 black and 1 white.
        beyond: grey levels (n, 2) beyond `ends` (n, 2) [px], inside and outside.
        cumulant: the fourth one of the blur across the edge, in units of `blur_px`.
        gradients: change of black and white (2, 2) per unit of s [grey levels] and of `steps` [grey levels/px].
        unlit: their variances (2, 2).
    """
    filters, information = _filters(steps, blur_px, _FREE)
    free, steady = (_shift_filter(steps, blur_px, level) for level in (_FREE, _LEVEL))
    filters[2] = free
    along = np.column_stack([np.ones_like(s), s])

    def levels(at: FloatArray) -> FloatArray:
        # Light changes slowly along an edge.
        return np.asarray(along @ np.linalg.lstsq(along, at @ filters[:2].T, rcond=None)[0], np.float64)

    side = ndtr(steps / blur_px)
    lit = [change[0] * s[:, None] + change[1] * steps for change in gradients]
    profiles = profiles - lit[0] * (1.0 - side) - lit[1] * side
    black, white = levels(profiles).T
    if (white - black).mean() < min_contrast:
        return Reason.LOW_CONTRAST
    shown = (beyond[:, :1] - black[:, None]) * blurred_step((ends[:, :1] - steps) / blur_px, cumulant)
    shown += (beyond[:, 1:] - white[:, None]) * blurred_step((steps - ends[:, 1:]) / blur_px, cumulant)
    cleared = profiles - shown
    black, white = levels(cleared).T
    contrast = white - black
    usual = float(contrast.mean())
    if usual < min_contrast:
        return Reason.LOW_CONTRAST
    contrast = np.maximum(contrast, 0.5 * usual)
    own = cleared @ filters.T
    ideal_held = (ideal - side) @ steady
    # Pixels shift and widen an ideal edge, too.
    shift, wider = (own[:, 2:] / contrast[:, None] - ideal @ filters[2:].T).T
    level = np.outer(1.0 - side, own[:, 0].mean()).T + np.outer(side, own[:, 1].mean()).T
    held = (cleared - level) @ steady / contrast - ideal_held
    clear = own[:, 1] - own[:, 0] > 0.5 * contrast
    told = float(np.square(contrast) @ clear) * information
    correction = -(shown @ filters[2]) / contrast
    # Both edges across a gradient are moved the same way: their errors add, which the factor allows for.
    sides = np.column_stack([1.0 - side, side])
    pulls = np.square(np.column_stack([filters[2] @ (sides * steps[:, None]), steady @ sides]) / usual)
    doubt = 2.0 * (pulls * unlit[:, ::-1]).sum(axis=0)
    widening = float((wider * np.square(contrast)) @ clear) * information
    light = (np.column_stack([black, white]) + np.outer(s, gradients[:, 0]))[[0, -1]]
    return _Points(shift, held, clear, correction, doubt, widening, told, light)


def blurred_step(places: FloatArray, cumulant: float) -> FloatArray:
    """Return the levels of a step from 0 to 1 at 0, at places in units of its blur.

    Edgeworth's series of a Gaussian blur and its fourth cumulant.
    """
    density = np.exp(-0.5 * places**2) / math.sqrt(2.0 * math.pi)
    return np.asarray(ndtr(places) - cumulant / 24.0 * (places**3 - 3.0 * places) * density, dtype=np.float64)


def _shift_filter(steps: FloatArray, blur_px: float, level: float) -> FloatArray:
    """Return the filter (m,) for the contrast times the shift of an edge, wider than the edge itself.

    An edge along the rows or columns has the same place within the pixels all along, so that what a pixel makes of its
    shape does not average out. A wider filter hardly depends on that shape.
    """
    shift = _filters(steps, math.hypot(blur_px, _WIDER_PX), level)[0][2]
    slope = np.exp(-0.5 * (steps / blur_px) ** 2) / (blur_px * math.sqrt(2.0 * math.pi))
    return np.asarray(-shift / (shift @ slope), np.float64)


def _filters(steps: FloatArray, blur_px: float, level: float) -> tuple[FloatArray, float]:
    """Return filters (4, m) over samples at `steps` (m,) [px], and the information in the last one's result.

    They give the levels of black and white at the edge, and the contrast times its shift and times the error of the
    blur. The last two are unbiased; what the light's gradients leave across the edge has a prior.
    """
    white, slope = ndtr(steps / blur_px), np.exp(-0.5 * (steps / blur_px) ** 2) / (blur_px * math.sqrt(2.0 * math.pi))
    sides = np.column_stack([1.0 - white, white])
    basis = np.column_stack([sides, -slope, -slope * steps / blur_px, sides * steps[:, None]])
    prior = np.diag([1.0 / level, 1.0 / level, 0.0, 1.0 / _FREE, 1.0 / _GRADIENT, 1.0 / _GRADIENT])
    cov = np.linalg.inv(basis.T @ basis + prior)
    return np.asarray((cov @ basis.T)[:4], np.float64), 1.0 / float(cov[3, 3])


def _line(
    s: FloatArray, points: _Points, config: TagConfig
) -> tuple[float, float, FloatArray, FloatArray, FloatArray] | Reason:
    """Fit a line through the points at s (n,); return the reason if there is none.

    The result is place, slope, `scatter`, `shared` and `residuals`, see `Edge`.
    """
    design, places = np.column_stack([np.ones_like(s), s]), points.steady
    kept, solution = points.clear, np.zeros(2)
    for _ in range(3):
        if kept.sum() < max(config.min_visible * len(s), _FEWEST_POINTS - 1):
            return Reason.OCCLUDED
        solution = np.linalg.lstsq(design[kept], places[kept], rcond=None)[0]
        residuals = places - design @ solution
        spread = max(_MAD_TO_SIGMA * float(np.median(np.abs(residuals[kept]))), _FLOOR_PX)
        agreeing = points.clear & (np.abs(residuals) <= _STRAY * spread)
        if (agreeing == kept).all():
            break
        kept = agreeing
    line = np.linalg.pinv(design[kept])
    both = np.column_stack([points.places, points.steady])[kept]
    place, slope = float(line[0] @ both[:, 0]), float(line[1] @ both[:, 1])
    residuals = both - design[kept] @ (line @ both)
    freedom = int(kept.sum()) - 2
    squares = np.maximum(np.square(residuals).sum(axis=0), freedom * _FLOOR_PX**2)
    # With few points the scatter may be larger than it seems: Student's t has this variance.
    sigmas = np.diag(np.sqrt(squares / max(freedom - 2.0, 1.0)))
    scatter = sigmas @ (line @ line.T) @ sigmas
    beyond = line @ points.beyond[kept]
    shared = _FLOOR_PX**2 * np.eye(2) + _BEYOND_SHARE**2 * np.outer(beyond, beyond)
    shared += np.diag(points.unlit)
    waves = np.zeros(len(s))
    waves[kept] = residuals[:, 1] * math.sqrt(freedom / squares[1])
    return place, slope, scatter, shared, waves
