"""Sub-pixel outline of a ball's image.

The image is sampled along rays from a rough centre. Along each ray the pixels go from the ball's colour to the
background's; how much of the ray the ball covers tells where its edge is. Coverage is measured along the direction in
colour space that tells ball from background best while the ball's brightness, which varies with shading, counts
for little: a shaded limb before a grey wall is told by its hue, a limb before black by its light. Both ends of
the mixture are taken next to the edge, per ray. So neither shading nor highlights pull the centre, and an
anti-aliased edge counts by its coverage.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from interfaces.records import FloatArray

from .colour import Float32Array, Gate
from .edge import EdgePoints, find_edge_points
from .rays import ball_colour, median, ray_angles, sample_rays

BoolArray = NDArray[np.bool_]

# Half-widths [px] of the ring in which the edge is looked for: about the rough circle, then about the outline.
_WINDOWS_PX = (3.5, 2.0, 2.0)
# The outline is found when a step moved it, centre and radius together, less than this [px].
_SETTLED_PX = 0.6
_RING_STEP_PX = 0.5
_BACKGROUND_PX = 2.0
_INNER_COLUMNS = 6
# How much any channel at the limb may differ from the one a little inside, brightness apart (1-sigma, grey levels).
_CHANNEL_SIGMA = 4.0
# A ray tells the edge where ball and background are this many of these sigmas apart.
_LEAST_SEPARATION = 3.0
# A limb with less than this part of the usual level is hidden behind something.
_LEAST_LEVEL = 0.2
# Error of one edge point before an even background [px]; an uneven one adds to it.
_EDGE_SIGMA_PX = 0.06
# Where the background makes a larger one [px], an edge elsewhere hides nothing.
_UNEVEN_PX = 0.4
# Residuals beyond this are no longer edge noise [px], whatever the spread is.
_LEAST_GATE_PX, _LARGEST_GATE_PX, _GATE_SIGMAS = 0.8, 2.0, 3.5
# The waves that tell the covariance go up to this one, or up to radius / _WAVE_RADIUS_PX if that is more.
_LEAST_WAVES, _WAVE_RADIUS_PX = 4, 3.0
# Lens and interpolation smooth along the outline too, which takes power from the quicker waves (1-sigma) [px].
_SMOOTHING_PX = 1.0
# The expected variance counts as this many degrees of freedom beside those of the waves.
_PRIOR_DEGREES = 4.0
# Points farther than this from the outline that was captured are no edges of the ball [px].
_FAR_PX = 1.0
# Passes of the exact fit, and where a point counts for a quarter (sigmas).
_PASSES, _FAR_SIGMAS = 7, 4.0
# So many rays on both sides of what hides the outline may be pulled by it.
_BESIDE = 4
# The exact fit has settled when a pass moves it less than this [px].
_UNMOVED_PX = 5e-4
# A correction for shading is right to this part of it (1-sigma).
_DOUBT = 0.5
# What is left when all noise has averaged out [px].
_FLOOR_PX = 0.005
# Below this, relative to the cubed trace, the outline points do not determine centre and radius.
_LEAST_DETERMINANT = 1e-5


@dataclass(frozen=True, slots=True)
class Outline:
    """A ball's outline, fitted.

    Attributes:
        centre_px: centre of the ellipse, shape (2,) [px].
        radius_px: radius of the circle of the same area [px].
        cov_px: covariance of the centre, shape (2, 2) [px²].
        visible: share of the outline that nothing hides.
        uneven: share of the outline at which the background is too uneven to tell.
        misfit: variance of the outline's points about the ellipse, in units of the one that the image's noise makes.
        scatter_px: 1-sigma of those points, far ones included [px].
    """

    centre_px: FloatArray
    radius_px: float
    cov_px: FloatArray
    visible: float
    uneven: float
    misfit: float
    scatter_px: float


@dataclass(frozen=True, slots=True)
class _Edges:
    """Where rays leave the ball, in the frame in which the outline is a circle around the rough centre.

    Attributes:
        angles: directions of the rays, shape (n,) [rad].
        distance_px: distance of the edge from the rough centre, shape (n,) [px].
        weight: how much each counts, 0..1, shape (n,); 0 where the ray does not tell.
        covered: where something else shows just inside the rough outline, shape (n,).
        uneven: where the background is too uneven to say that an edge elsewhere is not the ball's, shape (n,).
    """

    angles: FloatArray
    distance_px: FloatArray
    weight: FloatArray
    covered: BoolArray
    uneven: BoolArray


def fit_outline(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray
) -> Outline | None:
    """Refine a rough circle to the outline of the ball; None when there is no outline near it.

    Args:
        image: BGR, shape (height, width, 3), grey levels.
        centre_px: rough centre (2,), in the pixel coordinates of `image` [px].
        radius_px: rough radius [px], right to about a fifth.
        shape: the ellipse's shape (2, 2), see `sphere.Ellipse`.
    """
    found = _capture(image, gate, centre_px, radius_px, shape)
    if found is None:
        return None
    circle, edges = found
    points = find_edge_points(image, gate, circle.centre_px, circle.radius_px, shape, edges.angles)
    if points is None:
        return None
    told = circle.told & (np.abs(points.distance_px - circle.radius_px) < _FAR_PX)
    weight = np.where(told, points.sigma_px**-2, 0.0)
    exact = _solve(edges.angles, points, weight)
    if exact is None:
        return None
    return Outline(
        centre_px=circle.centre_px + shape @ exact.solution[:2],
        radius_px=float(exact.solution[2]),
        cov_px=shape @ exact.cov @ shape + _FLOOR_PX**2 * np.eye(2),
        visible=circle.visible,
        uneven=float(np.mean(edges.uneven)),
        misfit=exact.misfit,
        scatter_px=exact.scatter_px,
    )


@dataclass(frozen=True, slots=True)
class _Circle:
    """The outline to a tenth of a pixel.

    Attributes:
        centre_px, radius_px: centre (2,) and radius [px].
        visible: share of the outline that nothing hides.
        told: the rays that tell it, shape (n,); those next to what hides it do not.
    """

    centre_px: FloatArray
    radius_px: float
    visible: float
    told: BoolArray


def _capture(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray
) -> tuple[_Circle, _Edges] | None:
    """From the rough circle to the outline in ever narrower rings, and the edges around it."""
    found = None
    for window_px in _WINDOWS_PX:
        half = min(window_px, 0.6 * radius_px)
        edges = _find_edges(image, gate, centre_px, radius_px, shape, half)
        circle = None if edges is None else _fit_circle(edges, centre_px, shape)
        if edges is None or circle is None:
            return None
        moved_px = float(np.linalg.norm(circle.centre_px - centre_px)) + abs(circle.radius_px - radius_px)
        if moved_px > max(2.0, 0.5 * radius_px):
            return None
        found = circle, edges
        centre_px, radius_px = circle.centre_px, circle.radius_px
        if moved_px < _SETTLED_PX:
            break
    return found


def _find_edges(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray, half_px: float
) -> _Edges | None:
    angles = ray_angles(radius_px)
    cells = max(2, round(2 * half_px / _RING_STEP_PX))
    step = 2 * half_px / cells
    inner = np.linspace(0.3 * radius_px, radius_px - half_px, _INNER_COLUMNS)
    ring = radius_px - half_px + (np.arange(cells) + 0.5) * step
    outer = radius_px + half_px + (np.arange(round(_BACKGROUND_PX / _RING_STEP_PX)) + 0.5) * _RING_STEP_PX
    samples = sample_rays(image, centre_px, angles, np.concatenate([inner, ring, outer]), shape)
    inside, outside = samples[:, : len(inner)], samples[:, len(inner) + cells :]

    colour = ball_colour(inside, gate)
    if colour is None:
        return None
    level = np.maximum(_mean_of_three(gate.amount(inside[:, -2:]).mean(axis=1)), 0.0)
    covered = level < _LEAST_LEVEL * median(level)
    background = _mean_of_three(outside.mean(axis=1))
    towards, separation = _discriminant(level, colour, background, gate.shading_sigma)
    told = (separation > _LEAST_SEPARATION**2) & ~covered
    scale = 1.0 / np.where(told, separation, 1.0)
    # The share of ball in each sample: 1 on the ball, 0 on the background.
    share = np.matmul(samples[:, len(inner) :] - background[:, None], towards[:, :, None])[..., 0] * scale[:, None]
    distance = radius_px - half_px + share[:, :cells].sum(axis=1) * step
    unevenness_px = half_px * np.sqrt(np.mean(share[:, cells:] ** 2, axis=1))
    weight = told / (1.0 + (unevenness_px / _EDGE_SIGMA_PX) ** 2)
    return _Edges(angles, distance, weight, covered, ~told | (unevenness_px > _UNEVEN_PX))


def _discriminant(
    level: FloatArray, colour: FloatArray, background: FloatArray, shading_sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Fisher's linear discriminant between ball and background, ray by ray.

    The ball is `level · colour`, with a covariance of (σ_s · level)² along `colour` and of σ_c² in all channels.

    Args:
        level: the ball's level at the limb, shape (n,).
        background: shape (n, 3).

    Returns:
        The direction in colour space (n, 3), and the squared separation along it (n,) in sigmas.
    """
    apart = level[:, None] * colour - background
    along = (shading_sigma * level) ** 2
    # Inverse of σ_c² I + along · colour colourᵀ by Sherman and Morrison.
    share = along * (apart @ colour) / (_CHANNEL_SIGMA**2 + along * (colour @ colour))
    direction = (apart - share[:, None] * colour) / _CHANNEL_SIGMA**2
    return direction, np.einsum("nc,nc->n", direction, apart)


def _mean_of_three(values: NDArray[np.floating]) -> FloatArray:
    """Mean over three neighbours along the closed first axis."""
    wrapped = np.concatenate([values[-1:], values, values[:1]]).astype(np.float64)
    return (wrapped[:-2] + wrapped[1:-1] + wrapped[2:]) / 3.0


def _fit_circle(edges: _Edges, centre_px: FloatArray, shape: FloatArray) -> _Circle | None:
    """Least squares for the centre's shift and the radius; points too far off are left out in turn."""
    design = _design(edges.angles)
    told = edges.weight > 0
    weight, solution = edges.weight, np.zeros(3)
    for _ in range(3):
        if np.count_nonzero(weight) < len(weight) // 2:
            return None
        normal = (design * weight[:, None]).T @ design
        if _is_singular(normal):
            return None
        solution = np.linalg.solve(normal, design.T @ (weight * edges.distance_px))
        residual = np.abs(edges.distance_px - design @ solution)
        gate = min(max(_GATE_SIGMAS * 1.4826 * median(residual[told]), _LEAST_GATE_PX), _LARGEST_GATE_PX)
        weight = np.where(residual < gate, edges.weight, 0.0)
    if solution[2] <= 0:
        return None
    hidden = edges.covered | ((weight == 0) & ~edges.uneven)
    beside = np.any([np.roll(hidden, by) for by in range(-_BESIDE, _BESIDE + 1)], axis=0)
    seen = (weight > 0) & ~beside
    return _Circle(centre_px + shape @ solution[:2], float(solution[2]), 1.0 - float(np.mean(hidden)), seen)


@dataclass(frozen=True, slots=True)
class _Exact:
    """Shift of the centre and radius, shape (3,) [px]; covariance (2, 2) of the shift [px²]; else as in `Outline`."""

    solution: FloatArray
    cov: FloatArray
    misfit: float
    scatter_px: float


def _solve(angles: FloatArray, points: EdgePoints, weight: FloatArray) -> _Exact | None:
    """The circle through points at `angles` (n,) that count by `weight` (n,), 1 over their variance [1/px²]."""
    design, distance_px = _design(angles), points.distance_px
    used, residual, solution, normal = weight, distance_px, np.zeros(3), np.eye(3)
    for _ in range(_PASSES):
        if np.count_nonzero(used) < len(used) // 2:
            return None
        normal = (design * used[:, None]).T @ design
        if _is_singular(normal):
            return None
        before, solution = solution, np.linalg.solve(normal, design.T @ (used * distance_px))
        residual = distance_px - design @ solution
        if np.abs(solution - before).max() < _UNMOVED_PX:
            break
        sigmas = np.abs(residual) * np.sqrt(weight)
        usual = max(1.0, 1.4826 * median(sigmas[weight > 0]))
        # Geman and McClure's weights: a point far off counts for nothing in the end.
        used = weight / (1.0 + (sigmas / (_FAR_SIGMAS * usual)) ** 2) ** 2
    if solution[2] <= 0:
        return None
    density = _noise_density(angles, np.sqrt(used) * residual, float(solution[2]))
    scatter_px = math.sqrt(float(weight @ residual**2 / weight.sum()))
    inverse = np.linalg.inv(normal)[:2]
    moved = inverse @ (design.T @ (used * points.shading_px))
    return _Exact(solution, density * inverse[:, :2] + _DOUBT**2 * np.outer(moved, moved), density, scatter_px)


def _design(angles: FloatArray) -> FloatArray:
    return np.stack([np.cos(angles), np.sin(angles), np.ones_like(angles)], axis=1)


def _is_singular(normal: FloatArray) -> bool:
    return bool(np.linalg.det(normal) < _LEAST_DETERMINANT * np.trace(normal) ** 3)


def _noise_density(angles: FloatArray, residual: FloatArray, radius_px: float) -> float:
    """Variance of one outline point, in units of the one expected, in the slow waves round the outline.

    Neighbouring outline points share pixels and background, so their variance alone would claim too little. A
    shift of the centre is the wave that goes once round. It was fitted away, and the next ones tell its size, the
    nearer the better. There are few of them, so that the variance that the image's noise makes, which is
    known, counts as much as two more.
    """
    last = max(_LEAST_WAVES, round(radius_px / _WAVE_RADIUS_PX))
    harmonics = np.arange(2, last + 1)
    waves = np.exp(-1j * harmonics[:, None] * angles) @ residual
    power = np.abs(waves) ** 2 * np.exp((harmonics * _SMOOTHING_PX / radius_px) ** 2) / np.count_nonzero(residual)
    share = harmonics**-2.0 / np.sum(harmonics**-2.0)
    degrees = 2.0 / float(share @ share)
    # The posterior mean of a variance with an inverse gamma prior around 1.
    return (_PRIOR_DEGREES + degrees * float(share @ power)) / (_PRIOR_DEGREES + degrees)
