"""Measure a tag in one eye's image: its four corners to hundredths of a pixel, with their covariance.

The four edges of the black square are measured between the corners, where they are straight, see `edge`. The blur
is estimated from the edges themselves. The corners are the intersections of the edges' lines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from bodyschema.interfaces.records import FloatArray, ImageArray, Reason, frozen_array

from .bleed import bleed
from .config import TagConfig
from .dictionary import tag_modules
from .edge import INTERPOLATION, MODULES, Edges, Light, find_edges
from .settings import EdgeSettings
from .settings import TagSettings as _Settings

_PREVIOUS_EDGE = np.array([3, 0, 1, 2])  # edges before each edge
_NO_GRADIENT = Light(np.zeros((2, 2)), np.zeros((2, 2, 2)))


@dataclass(frozen=True, slots=True)
class TagImage:
    """A tag in one eye's image.

    Attributes:
        id: its number in the dictionary.
        corners_px: its corners (4, 2) [px]: top left, top right, bottom right, bottom left of the tag as printed.
        cov_px: covariance (8, 8) of u and v of the first, then of the second corner ... [px²].
        skew_px: 1-sigma (4, 2) [px] of the common shift of all tags' corners due to the unknown readout of the rows.
    """

    id: int
    corners_px: FloatArray
    cov_px: FloatArray
    skew_px: FloatArray = field(default_factory=lambda: np.zeros((1, 2)))


def measure_tag(grey: ImageArray, id: int, corners_px: FloatArray, config: TagConfig) -> TagImage | Reason:
    """Measure the tag whose corners are near `corners_px` (4, 2) in a grey image, or return the reason for doubt."""
    found = _measured(grey, id, corners_px, 1.0, config)
    if isinstance(found, Reason):
        # The margin may be narrower than a module, the tag very oblique, or near the image's border.
        again = _measured(grey, id, corners_px, _Settings.shorter, config)
        return again if isinstance(again, TagImage) else found
    return found


def _measured(
    grey: ImageArray, id: int, corners_px: FloatArray, length_share: float, config: TagConfig
) -> TagImage | Reason:
    """Measure the tag with shorter lines across its edges, by the factor `length_share`."""
    blur_px = _Settings.usual_blur_px
    light: Light | None = None
    number, previous_px = 0, math.inf
    while True:
        edges = find_edges(grey, corners_px, blur_px, light, length_share)
        if isinstance(edges, Reason):
            return edges
        number += 1
        moved = _intersections(edges)
        moved_px = float(np.abs(moved - corners_px).max())
        module_px = 2.0 * float(edges.half_lengths.min()) / MODULES
        if moved_px > max(EdgeSettings.longest_reach_px, module_px):
            return Reason.OCCLUDED
        corners_px, blur_px = moved, _blur(edges, blur_px)
        if light is None:
            previous_px = moved_px
            light = _NO_GRADIENT if moved_px < _Settings.rough_share * module_px or number >= _Settings.rounds else None
            continue
        light = _light(edges)
        # Each round moves the corners less, by about the same factor.
        if min(moved_px, moved_px * moved_px / previous_px) < _Settings.settled_px or number >= 2 * _Settings.rounds:
            break
        previous_px = moved_px
    shortest_px = 2.0 * float(edges.half_lengths.min())
    if shortest_px < _Settings.min_side_px:
        return Reason.NO_MARKER
    bled_px, bled_var = bleed(grey, corners_px, blur_px, tag_modules(config.dictionary, id))
    edges = replace(edges, offsets=edges.offsets + bled_px)
    cov_px = _corner_covariance(edges, bled_var)
    if math.sqrt(float(np.diag(cov_px).max())) > _Settings.max_corner_sigma * shortest_px:
        return Reason.BLURRED if blur_px * MODULES > _Settings.max_blur * shortest_px else Reason.NOT_STRAIGHT
    return TagImage(id, _intersections(edges), cov_px)


def _blur(edges: Edges, previous_px: float) -> float:
    """Estimate the blur (1-sigma) [px] of all edges, from the previous estimate `previous_px`."""
    return max(previous_px + edges.widening / edges.information, EdgeSettings.sharpest_px)


def _light(edges: Edges) -> Light:
    """Return the light estimated from the levels along the edges."""
    spots, levels = edges.spots.reshape(-1, 2), edges.levels.reshape(-1, 2)
    design = spots - spots.mean(axis=0)
    inverse = np.linalg.inv(design.T @ design)
    gradients = inverse @ design.T @ levels
    residuals = levels - levels.mean(axis=0) - design @ gradients
    variance = np.square(residuals).sum(axis=0) / (len(spots) - 3)
    return Light(np.asarray(gradients.T, np.float64), variance[:, None, None] * inverse)


def _variance_ratios(edges: Edges) -> FloatArray:
    """Return the variances (2,) of an edge's place and slope relative to those for independent points.

    Interpolation and blur spread a pixel's noise to its neighbours, and neither a print nor a lens is straight. So slow
    waves along the edges have more noise than quick ones. The power of waves of index k from 2 on is that of a random
    walk, b/k², on top of the noise a. Place and slope are the waves of index 1/2 and 1.
    """
    waves = [_slow_waves(len(points)) for points in edges.residuals]
    power = np.concatenate([np.square(w @ points) for w, points in zip(waves, edges.residuals, strict=True)])
    index = np.concatenate([np.arange(2.0, 2.0 + len(w)) for w in waves])
    # The prior counts as waves too quick to show a random walk.
    spacing = np.linalg.norm(edges.spots[:, 1] - edges.spots[:, 0], axis=1) / [len(r) - 1 for r in edges.residuals]
    # White noise, smoothed as by a Gaussian of interpolation's variance; distant points are independent.
    smoothed = max(math.sqrt(4.0 * math.pi * INTERPOLATION) * float(np.mean(1.0 / spacing)), 1.0)
    power = np.append(power, smoothed)
    design = np.stack([np.ones_like(power), np.append(index**-2.0, 0.0)])
    count = np.append(np.ones_like(index), _Settings.smoothed_waves)
    weights = np.append(index**-1.0, 1.0) * count
    white_noise = float(weights @ power / weights.sum())
    cov = np.linalg.inv(design * count @ design.T)
    level = cov @ (design * count) @ power
    noise, walk_power = max(float(level[0]), 0.0), max(float(level[1]), 1e-9)
    chance = math.sqrt(2.0 * float(cov[1, 1])) * max(noise, smoothed)
    # Walks within chance are ignored, larger ones are shrunk a little (James and Stein).
    walk = walk_power * max(1.0 - (_Settings.chance * chance / walk_power) ** 2, 0.0)
    return (noise if walk else white_noise) + walk * np.array([4.0, 1.0])


@lru_cache
def _slow_waves(count: int) -> FloatArray:
    """Return the cosine waves (k, n) of unit power along n points, from index 2 on, that are slow."""
    index = np.arange(2, min(max(count // _Settings.slow, _Settings.slow), count))
    angles = np.pi / count * np.outer(index, np.arange(count) + 0.5)
    return frozen_array(math.sqrt(2.0 / count) * np.cos(angles))


def _intersections(edges: Edges) -> FloatArray:
    """Return the intersections (4, 2) [px] of each edge's line with that of the edge before it."""
    points, directions = edges.points, edges.directions
    previous, across = directions[_PREVIOUS_EDGE], points - points[_PREVIOUS_EDGE]
    # Cramer's rule
    steps = across[:, 0] * directions[:, 1] - across[:, 1] * directions[:, 0]
    steps /= previous[:, 0] * directions[:, 1] - previous[:, 1] * directions[:, 0]
    return points[_PREVIOUS_EDGE] + steps[:, None] * previous


def _corner_covariance(edges: Edges, common_var: float) -> FloatArray:
    """Return the covariance (8, 8) of the corners; each lies on the edge before it and on its own edge.

    A corner x on both lines n·x = place moves by dx with n₁·dx = dp₁ and n₂·dx = dp₂. dp is the shift of the line at
    the corner: that of its place, plus that of its slope times s. `common_var` is the variance [px²] of the shift of
    all edges.
    """
    directions = edges.directions / np.linalg.norm(edges.directions, axis=1)[:, None]
    normals = np.column_stack([directions[:, 1], -directions[:, 0]])
    by_edge = np.zeros((4, 2, 4, 2))
    cov = np.zeros((4, 2, 4, 2))
    cov[:, 0, :, 0] = common_var
    cov[range(4), :, range(4)] += (
        np.sqrt(np.multiply.outer(*[_variance_ratios(edges)] * 2)) * edges.scatter + edges.shared
    )
    solve = np.linalg.inv(np.stack([normals[_PREVIOUS_EDGE], normals], axis=1))
    # The corner is the end (s = 1) of the edge before it, and the beginning (s = −1) of its own.
    by_edge[range(4), :, _PREVIOUS_EDGE] = solve[:, :, :1] * (1.0, 1.0)
    by_edge[range(4), :, range(4)] = solve[:, :, 1:] * (1.0, -1.0)
    rows = by_edge.reshape(8, 8)
    return rows @ cov.reshape(8, 8) @ rows.T
