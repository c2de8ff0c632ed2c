"""Measure a tag in one eye's image: its four corners to hundredths of a pixel, with their covariance.

The four edges of the black square are measured where they are straight, between the corners, see `tag_edge`. The blur
is estimated from the edges themselves. The corners are the intersections of the edges' lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import dct

from bodyschema.interfaces.records import FloatArray, ImageArray, Reason

from .tag_config import TagConfig
from .tag_edge import LONGEST_REACH_PX, SHARPEST_PX, Edge, find_edge

# Most iterations; converged when no corner moved by more than this [px] and the blur by no more than this share.
_ROUNDS, _SETTLED_PX, _SETTLED_BLUR = 8, 0.01, 0.02
# Initial blur of lens and interpolation (1-sigma), and the largest [px].
_USUAL_BLUR_PX, _WIDEST_PX = 0.85, 3.0
# Weight of the initial blur; an edge whose lines reach twice as far as its blur has weight 1.
_USUAL_WEIGHT = 0.1
# Prior factor by which interpolation correlates neighbouring points' errors, and its weight in waves along the edges.
_SMOOTHED, _SMOOTHED_WAVES = 1.5, 10
# Slow waves have half-periods of at least this many points; least upper bound of their indices.
_SLOW, _LEAST_QUICKEST = 4, 4


@dataclass(frozen=True, slots=True)
class TagImage:
    """A tag in one eye's image.

    Attributes:
        id: its number in the dictionary.
        corners_px: its corners (4, 2) [px]: top left, top right, bottom right, bottom left of the tag as printed.
        cov_px: covariance (8, 8) of u and v of the first, then of the second corner ... [px²].
    """

    id: int
    corners_px: FloatArray
    cov_px: FloatArray


def measure_tag(grey: ImageArray, id: int, corners_px: FloatArray, config: TagConfig) -> TagImage | Reason:
    """Measure the tag whose corners are near `corners_px` (4, 2) in a grey image, or return why it is doubtful."""
    edges: list[Edge] = []
    blur_px = _USUAL_BLUR_PX
    for _ in range(_ROUNDS):
        found = [find_edge(grey, corners_px, side, blur_px, config) for side in range(4)]
        reasons = [edge for edge in found if isinstance(edge, Reason)]
        if reasons:
            return reasons[0]
        edges = [edge for edge in found if isinstance(edge, Edge)]
        moved = np.array([_meeting(edges[side - 1], edges[side]) for side in range(4)])
        moved_px, before_px = float(np.abs(moved - corners_px).max()), blur_px
        if moved_px > LONGEST_REACH_PX:
            return Reason.OCCLUDED
        corners_px, blur_px = moved, _blur(edges, blur_px)
        if moved_px < _SETTLED_PX and abs(blur_px - before_px) < _SETTLED_BLUR * blur_px:
            break
    return TagImage(id, corners_px, _corner_covariance(edges))


def _blur(edges: list[Edge], before_px: float) -> float:
    """Estimate the blur (1-sigma) [px] of all edges, from the previous estimate `before_px`.

    An edge whose lines hardly reach beyond its blur has little weight.
    """
    weights = [max(edge.reach_px / before_px - 1.0, 0.0) ** 2 for edge in edges]
    ratios = [edge.area_px / edge.expected_area_px for edge in edges]
    change = (_USUAL_WEIGHT * _USUAL_BLUR_PX / before_px + np.dot(weights, ratios)) / (_USUAL_WEIGHT + sum(weights))
    return min(max(before_px * float(change), SHARPEST_PX), _WIDEST_PX)


def _likeness(edges: list[Edge]) -> float:
    """Return the variance of neighbouring points' mean relative to that of independent points.

    Interpolation and blur spread a pixel's noise to its neighbours. So slow waves along the edges, of which place and
    slope are the slowest, have more noise than quick ones.
    """
    power, count = _SMOOTHED_WAVES * _SMOOTHED, float(_SMOOTHED_WAVES)
    for edge in edges:
        quickest = max(len(edge.residuals) // _SLOW, _LEAST_QUICKEST)
        slow = np.asarray(dct(edge.residuals, norm="ortho"))[2:quickest]
        power, count = power + float(np.square(slow).sum()), count + len(slow)
    return power / count


def _meeting(one: Edge, other: Edge) -> FloatArray:
    """Return the intersection (2,) [px] of two edges' lines."""
    steps = np.linalg.solve(np.column_stack([one.direction, -other.direction]), other.point - one.point)
    return one.point + steps[0] * one.direction


def _corner_covariance(edges: list[Edge]) -> FloatArray:
    """Return the covariance (8, 8) of the corners; each lies on the edge before it and on its own edge.

    A corner x on both lines n·x = place moves by dx with n₁·dx = dp₁ and n₂·dx = dp₂, where dp is the line's shift
    there: that of its place, and of its slope times s.
    """
    likeness = _likeness(edges)
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
        cov[2 * number : 2 * number + 2, 2 * number : 2 * number + 2] = likeness * edge.scatter + edge.shared
    return by_edge @ cov @ by_edge.T


def _unit_normal(edge: Edge) -> FloatArray:
    direction = edge.direction / np.linalg.norm(edge.direction)
    return np.array([direction[1], -direction[0]])
