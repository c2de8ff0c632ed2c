"""Measure one straight edge of a tag's black square to hundredths of a pixel, with its uncertainty.

The share of black along lines across the edge gives its position, so an anti-aliased edge counts by its coverage. Two
errors are subtracted: the light that blur brings from the modules beyond and from the end of the paper, and the
apparent shift of an ideal edge of that blur on the same pixels.
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

from .tag_config import TagConfig

# Black border, data and border of all dictionaries that are offered: 6 + 2 modules.
MODULES = 8.0
# Distance in blurs that lines across an edge keep from the ends of black border and white margin (one module each);
# nearer, more than a twentieth of the modules beyond shows.
_CLEAR_BLURS = 1.7
LONGEST_REACH_PX, _SHORTEST_REACH_PX = 6.0, 1.0
# Least ratio of an edge's apparent shift to its true shift; lines that are too short beside the blur have less.
_LEAST_GAIN = 0.12
_SAMPLE_PX = 0.5
# Ends of the lines across, as a share of their reach, which show plain black and plain white.
_PLAIN = 0.35
# Distance from the corners, whose blur rounds the edges off: blurs, and share of the side.
_CORNER_BLURS, _CORNER_SHARE = 2.6, 0.08
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
        reach_px: length of the lines across the edge to either side [px].
        area_px, expected_area_px: apparent and expected width of the edge, see `_spread` [px].
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
    reach_px: float
    area_px: float
    expected_area_px: float

    @property
    def point(self) -> FloatArray:
        return self.origin + self.place * self.normal

    @property
    def direction(self) -> FloatArray:
        return self.along * self.half_length + self.slope * self.normal


@dataclass(frozen=True, slots=True)
class _Points:
    """Points of an edge on the lines across it.

    Attributes:
        places: position of the edge on each line, outward (n,) [px].
        together: contribution of each line to the position of the whole edge (n,) [px].
        beyond: correction for the modules beyond (n,) [px].
        farther: factor by which the edge is farther off than these say together.
        area_px, expected_area_px: apparent and expected width of the edge, see `_spread` [px].
    """

    places: FloatArray
    together: FloatArray
    beyond: FloatArray
    farther: float
    area_px: float
    expected_area_px: float


def find_edge(grey: ImageArray, corners_px: FloatArray, side: int, blur_px: float, config: TagConfig) -> Edge | Reason:
    """Measure the edge from corner `side` to the next one, or return the reason why it cannot be measured."""
    quad = np.roll(corners_px, -side, axis=0)
    begin, end = quad[:2]
    length = float(np.linalg.norm(end - begin))
    if length < config.min_side_px:
        return Reason.NO_MARKER
    along = (end - begin) / length
    normal = np.array([along[1], -along[0]])  # corners go round clockwise: out of the tag
    to_px = np.asarray(cv2.getPerspectiveTransform(MODULES * _SQUARE, quad.astype(np.float32)), np.float64)
    reach = min(float(np.abs(_module_ends(to_px, quad[:2], normal)).min()) - _CLEAR_BLURS * blur_px, LONGEST_REACH_PX)
    if not reach >= _SHORTEST_REACH_PX:
        return Reason.NO_MARKER
    # At an acute corner, nearby lines leave the tag through its other side.
    sides = quad[[3, 2]] - quad[:2]
    leaning = (sides @ along) / (sides @ normal) * (-reach, reach)
    free = max(_CORNER_BLURS * blur_px, _CORNER_SHARE * length) + np.maximum(leaning, 0.0)
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
    cumulant = PIXEL_CUMULANT * float((normal**4).sum()) / blur_px**4
    found = _points(_sampled(grey, places), ideal, steps, beyond, ends, blur_px, cumulant, config.min_contrast)
    if isinstance(found, Reason):
        return found
    line = _line(s, found, config)
    if isinstance(line, Reason):
        return line
    return Edge(origin, along, normal, 0.5 * length, *line, reach, found.area_px, found.expected_area_px)


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


def _points(
    profiles: FloatArray,
    ideal: FloatArray,
    steps: FloatArray,
    beyond: FloatArray,
    ends: FloatArray,
    blur_px: float,
    cumulant: float,
    min_contrast: float,
) -> _Points | Reason:
    """Return the edge's points on the lines across it, or the reason why there are none.

    Reasons: no black inside or no white outside, or lines that are too short.

    Args:
        profiles: grey levels (n, m) at `steps` (m,) [px].
        ideal: levels of an ideal edge at 0 there, 0 black and 1 white.
        beyond: grey levels (n, 2) beyond `ends` (n, 2) [px], inside and outside.
        cumulant: the fourth one of the blur across the edge, in units of `blur_px`.
    """
    step = float(steps[1] - steps[0])
    reach = 0.5 * step * len(steps)
    plain = max(1, round(_PLAIN * len(steps) / 2.0))
    # What an ideal edge at 0 has of the other side at the plain ends.
    tail = float(ndtr(steps[:plain] / blur_px).mean())

    def levels(at: FloatArray) -> tuple[float, float]:
        black, white = float(at[:, :plain].mean()), float(at[:, -plain:].mean())
        excess = tail * (white - black) / (1.0 - 2.0 * tail)
        return black - excess, white + excess

    black, white = levels(profiles)
    if white - black < min_contrast:
        return Reason.OCCLUDED
    shown = (beyond[:, :1] - black) * blurred_step((ends[:, :1] - steps) / blur_px, cumulant)
    shown += (beyond[:, 1:] - white) * blurred_step((steps - ends[:, 1:]) / blur_px, cumulant)
    cleared = profiles - shown
    with_beyond = (white - profiles).sum(axis=1) * step / (white - black)
    black, white = levels(cleared)
    contrast = white - black
    if contrast < min_contrast:
        return Reason.OCCLUDED
    share = (white - cleared) / contrast
    # Pixels have their say in where an ideal edge seems to be, too.
    ideal_black, ideal_white = levels(ideal)
    ideal_share = (ideal_white - ideal) / (ideal_white - ideal_black)
    places = (share - ideal_share).sum(axis=1) * step
    # What each line makes of the place of all points: its own, and by its part in the levels all others.
    level = cleared[:, :plain].mean(axis=1) + cleared[:, -plain:].mean(axis=1)
    together = places + reach * (level - level.mean()) / contrast
    # What a point off by 1 px shows as on such short lines, and, as the levels go along, what all points do.
    own = float(1.0 - 2.0 * ndtr(-reach / blur_px))
    slope = np.exp(-0.5 * (steps[:plain] / blur_px) ** 2) / (blur_px * math.sqrt(2.0 * math.pi))
    gain = own - 2.0 * reach * float(slope.mean())
    if gain < _LEAST_GAIN:
        return Reason.NO_MARKER
    spread = _spread(share.mean(axis=0), steps, float(places.mean()) / gain, blur_px)
    return _Points(places / own, together / own, (share.sum(axis=1) * step - with_beyond) / own, own / gain, *spread)


def blurred_step(places: FloatArray, cumulant: float) -> FloatArray:
    """Return the levels of a step from 0 to 1 at 0, at places in units of its blur.

    Edgeworth's series of a Gaussian blur and its fourth cumulant.
    """
    density = np.exp(-0.5 * places**2) / math.sqrt(2.0 * math.pi)
    return np.asarray(ndtr(places) - cumulant / 24.0 * (places**3 - 3.0 * places) * density, dtype=np.float64)


def _spread(share: FloatArray, steps: FloatArray, place: float, blur_px: float) -> tuple[float, float]:
    """Return the area between the shares of black (m,) at `steps` (m,) [px] and a sharp edge at 0, and that expected.

    The expected area is that of an edge at `place` [px] with this blur, at the same steps. Both are in px.
    """
    expected = ndtr((place - steps) / blur_px)
    step = float(steps[1] - steps[0])
    area, expected_area = (float(np.where(steps < 0.0, 1.0 - each, each).sum()) for each in (share, expected))
    return area * step, expected_area * step


def _line(
    s: FloatArray, points: _Points, config: TagConfig
) -> tuple[float, float, FloatArray, FloatArray, FloatArray] | Reason:
    """Fit a line through the points at s (n,); return the reason if there is none.

    The result is place, slope, `scatter`, `shared` and `residuals`, see `Edge`.
    """
    design, places = np.column_stack([np.ones_like(s), s]), points.places
    kept, spread, solution = np.ones(len(s), dtype=bool), 0.0, np.zeros(2)
    for _ in range(3):
        chosen = design[kept]
        solution = np.linalg.solve(chosen.T @ chosen, chosen.T @ places[kept])
        residuals = places - design @ solution
        spread = max(_MAD_TO_SIGMA * float(np.median(np.abs(residuals[kept]))), _FLOOR_PX)
        agreeing = np.abs(residuals) <= _STRAY * spread
        if agreeing.sum() < _FEWEST_POINTS - 1:
            return Reason.OCCLUDED
        if (agreeing == kept).all():
            break
        kept = agreeing
    residuals = places - design @ solution
    count = int(kept.sum())
    freedom = count - 2
    if count < max(config.min_visible * len(s), _FEWEST_POINTS - 1) or spread > config.max_edge_px:
        return Reason.OCCLUDED
    line = np.linalg.inv(design[kept].T @ design[kept]).astype(np.float64) @ design[kept].T
    together = (points.together - design @ (line @ points.together[kept]))[kept]
    squares = np.maximum([np.square(each).sum() for each in (together, residuals[kept])], freedom * _FLOOR_PX**2)
    # With few points the scatter may be larger than it seems: Student's t has this variance.
    sigmas = np.diag(np.sqrt(squares / max(freedom - 2.0, 1.0)))
    beyond = line @ points.beyond[kept]
    shared = _FLOOR_PX**2 * np.eye(2) + _BEYOND_SHARE**2 * np.outer(beyond, beyond)
    scaled = np.where(kept, residuals, 0.0) * math.sqrt(freedom / squares[1])
    farther = np.diag([points.farther, 1.0])
    place, slope = (farther @ solution).tolist()
    scatter = farther @ sigmas @ (line @ line.T) @ sigmas @ farther
    return place, slope, scatter, farther @ shared @ farther, scaled
