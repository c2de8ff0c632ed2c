"""One eye's image of a tag: its four corners to hundredths of a pixel, with their covariance.

The four edges of the black square are measured where they are straight, between the corners: along lines across an
edge, the share of black tells where the edge is. That needs no model of the blur, and an anti-aliased edge counts by
its coverage. The corners are where the edges' lines meet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from interfaces.records import FloatArray, ImageArray, Reason

from .tag_config import TagConfig

# Black border, data and border of all dictionaries that are offered: 6 + 2 modules.
MODULES = 8.0
# The black border and the white margin are one module wide each. Lines across an edge stay so far from where they end:
# blur mixes what is beyond into them.
_CLEAR_PX = 1.8
_LONGEST_REACH_PX, _SHORTEST_REACH_PX = 6.0, 1.0
_SAMPLE_PX = 0.5
# Ends of the lines across, as a share of their reach, which show plain black and plain white.
_PLAIN = 0.35
# Free of the corners, whose blur rounds the edges off.
_CORNER_PX, _CORNER_SHARE = 2.0, 0.08
_FEWEST_POINTS, _MOST_POINTS = 6, 80
_ROUNDS = 3
# Interpolation between pixels takes up to this factor from the variance of a point, and gives it to its neighbours.
_SMOOTHED = 1.5
# What is left of an edge's place when all noise has averaged out [px].
_FLOOR_PX = 0.006
# Points so many (robust) standard deviations off their line are no part of it.
_STRAY = 3.5
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True)
class TagImage:
    """A tag as one eye sees it.

    Attributes:
        id: its number in the dictionary.
        corners_px: its corners (4, 2) [px]: top left, top right, bottom right, bottom left of the tag as printed.
        cov_px: covariance (8, 8) of u and v of the first, then of the second corner ... [px²].
    """

    id: int
    corners_px: FloatArray
    cov_px: FloatArray


@dataclass(frozen=True, slots=True)
class _Edge:
    """A line u·normal = place + slope·s, s from −1 to 1 between the edge's ends, and the covariance of both."""

    origin: FloatArray
    along: FloatArray
    normal: FloatArray
    half_length: float
    place: float
    slope: float
    cov: FloatArray

    @property
    def point(self) -> FloatArray:
        return self.origin + self.place * self.normal

    @property
    def direction(self) -> FloatArray:
        return self.along * self.half_length + self.slope * self.normal


def measure_tag(grey: ImageArray, id: int, corners_px: FloatArray, config: TagConfig) -> TagImage | Reason:
    """The tag whose corners are about at `corners_px` (4, 2) in a grey image, or why it is doubtful."""
    edges: list[_Edge] = []
    for _ in range(_ROUNDS):
        found = [_edge(grey, corners_px, side, config) for side in range(4)]
        reasons = [edge for edge in found if isinstance(edge, Reason)]
        if reasons:
            return reasons[0]
        edges = [edge for edge in found if isinstance(edge, _Edge)]
        moved = np.array([_meeting(edges[side - 1], edges[side]) for side in range(4)])
        if np.abs(moved - corners_px).max() > _LONGEST_REACH_PX:
            return Reason.OCCLUDED
        corners_px = moved
    return TagImage(id, corners_px, _corner_covariance(edges))


def _edge(grey: ImageArray, corners_px: FloatArray, side: int, config: TagConfig) -> _Edge | Reason:
    """The edge from corner `side` to the next one."""
    begin, end = corners_px[side], corners_px[(side + 1) % 4]
    length = float(np.linalg.norm(end - begin))
    if length < config.min_side_px:
        return Reason.NO_MARKER
    along = (end - begin) / length
    normal = np.array([along[1], -along[0]])  # corners go round clockwise: out of the tag
    depth = min(float(-normal @ (corners_px[side - 1] - begin)), float(-normal @ (corners_px[(side + 2) % 4] - end)))
    reach = min(depth / MODULES - _CLEAR_PX, _LONGEST_REACH_PX)
    free = max(_CORNER_PX, _CORNER_SHARE * length)
    count = min(int(length - 2.0 * free), _MOST_POINTS)
    if reach < _SHORTEST_REACH_PX or count < _FEWEST_POINTS:
        return Reason.NO_MARKER
    s = np.linspace(2.0 * free / length - 1.0, 1.0 - 2.0 * free / length, count)
    origin = (begin + end) / 2.0
    points = origin + 0.5 * length * s[:, None] * along
    profiles = _profiles(grey, points, normal, reach)
    if profiles is None:
        return Reason.AT_BORDER
    offsets = _offsets(profiles, reach, config.min_contrast)
    if offsets is None:
        return Reason.OCCLUDED
    line = _line(s, *offsets, config)
    return line if isinstance(line, Reason) else _Edge(origin, along, normal, 0.5 * length, *line)


def _profiles(grey: ImageArray, points: FloatArray, normal: FloatArray, reach: float) -> FloatArray | None:
    """Grey levels (n, m) across the edge at points (n, 2), from inside out; None where they leave the image."""
    count = 2 * math.ceil(reach / _SAMPLE_PX)
    steps = (np.arange(count) + 0.5) * (2.0 * reach / count) - reach
    places = points[:, None] + steps[:, None] * normal
    height, width = grey.shape
    if (places < 1.0).any() or (places > (width - 2.0, height - 2.0)).any():
        return None
    # By hand: cv2.remap would round places to 1/32 px.
    whole = np.floor(places).astype(np.intp)
    part = places - whole
    u, v = whole[..., 0], whole[..., 1]
    top = grey[v, u] * (1.0 - part[..., 0]) + grey[v, u + 1] * part[..., 0]
    bottom = grey[v + 1, u] * (1.0 - part[..., 0]) + grey[v + 1, u + 1] * part[..., 0]
    return top * (1.0 - part[..., 1]) + bottom * part[..., 1]


def _offsets(profiles: FloatArray, reach: float, min_contrast: float) -> tuple[FloatArray, float] | None:
    """Where the edge is on each line across (n,) [px], outward, and the variance [px²] that all have in common.

    None where there is no black inside or no white outside.
    """
    count = profiles.shape[1]
    plain = max(1, round(_PLAIN * count / 2.0))
    inside, outside = profiles[:, :plain], profiles[:, -plain:]
    black, white = float(inside.mean()), float(outside.mean())
    contrast = white - black
    if contrast < min_contrast:
        return None
    share = (white - profiles) / contrast
    places = share.sum(axis=1) * (2.0 * reach / count) - reach
    # A wrong level moves all points alike, by what lies between the plain ends: there it cancels with their noise.
    level = float(inside.var() + outside.var()) / max(inside.size * _SAMPLE_PX, 1.0)
    return places, ((1.0 - _PLAIN) * reach / contrast) ** 2 * level


def _line(
    s: FloatArray, places: FloatArray, common: float, config: TagConfig
) -> tuple[float, float, FloatArray] | Reason:
    """Place, slope and their covariance (2, 2) of the line through points at s (n,); a reason where there is none."""
    design = np.column_stack([np.ones_like(s), s])
    kept, scatter, solution = np.ones(len(s), dtype=bool), 0.0, np.zeros(2)
    for _ in range(3):
        chosen = design[kept]
        solution = np.linalg.solve(chosen.T @ chosen, chosen.T @ places[kept])
        residuals = places - design @ solution
        scatter = max(_MAD_TO_SIGMA * float(np.median(np.abs(residuals[kept]))), _FLOOR_PX)
        agreeing = np.abs(residuals) <= _STRAY * scatter
        if agreeing.sum() < _FEWEST_POINTS - 1:
            return Reason.OCCLUDED
        if (agreeing == kept).all():
            break
        kept = agreeing
    residuals = places - design @ solution
    count = int(kept.sum())
    freedom = count - 2
    if count < max(config.min_visible * len(s), _FEWEST_POINTS - 1) or scatter > config.max_edge_px:
        return Reason.OCCLUDED
    # With few points the scatter may be larger than it seems: Student's t has this variance.
    variance = float(np.square(residuals[kept]).sum()) / max(freedom - 2.0, 1.0)
    cov = np.asarray(_SMOOTHED * variance * np.linalg.inv(design[kept].T @ design[kept]), dtype=np.float64)
    cov += np.diag([common + _FLOOR_PX**2, _FLOOR_PX**2])
    return float(solution[0]), float(solution[1]), cov


def _meeting(one: _Edge, other: _Edge) -> FloatArray:
    """Where two edges' lines meet (2,) [px]."""
    steps = np.linalg.solve(np.column_stack([one.direction, -other.direction]), other.point - one.point)
    return one.point + steps[0] * one.direction


def _corner_covariance(edges: list[_Edge]) -> FloatArray:
    """Covariance (8, 8) of the corners: each belongs to the edge before it and to its own.

    A corner x on both lines n·x = place moves by dx with n₁·dx = dp₁ and n₂·dx = dp₂, where dp is the line's shift
    there: that of its place, and of its slope times s.
    """
    by_edge = np.zeros((8, 8))
    for corner in range(4):
        before, after = edges[corner - 1], edges[corner]
        solve = np.linalg.inv(np.array([_unit_normal(before), _unit_normal(after)]))
        rows = slice(2 * corner, 2 * corner + 2)
        # The corner is the end (s = 1) of the edge before it, and the beginning (s = −1) of its own.
        for column, edge_number, s in ((0, (corner - 1) % 4, 1.0), (1, corner, -1.0)):
            by_edge[rows, 2 * edge_number] += solve[:, column]
            by_edge[rows, 2 * edge_number + 1] += s * solve[:, column]
    cov = np.zeros((8, 8))
    for number, edge in enumerate(edges):
        cov[2 * number : 2 * number + 2, 2 * number : 2 * number + 2] = edge.cov
    return by_edge @ cov @ by_edge.T


def _unit_normal(edge: _Edge) -> FloatArray:
    direction = edge.direction / np.linalg.norm(edge.direction)
    return np.array([direction[1], -direction[0]])
