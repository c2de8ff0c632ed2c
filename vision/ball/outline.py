"""Fit the sub-pixel outline of a ball's image.

The image is sampled along rays from a rough centre. Along each ray the pixels change from the ball's colour to the
background's, and the share of the ray that the ball covers gives its edge. Coverage is measured along the direction in
colour space that best separates ball and background. The ball's brightness, which varies with shading, has little
weight: a shaded limb in front of a grey wall is found by its hue, a limb in front of black by its light. Both ends of
the mixture are sampled next to the edge, per ray. So neither shading nor highlights bias the centre, and an
anti-aliased edge counts by its coverage.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

from .colour import Float32Array, Gate
from .contour_fit import fit_contour
from .contour_spectrum import residual_spectrum
from .polar import ball_colour, fit_circle, mean_of_three, median, rays_round, sample
from .settings import ContourSettings
from .settings import OutlineSettings as _Settings

BoolArray = NDArray[np.bool_]

_TRIPLES = np.array(list(combinations(range(_Settings.arcs), 3)))


@dataclass(frozen=True, slots=True)
class Outline:
    """A ball's outline, fitted."""

    centre_px: FloatArray  # centre of the ellipse, shape (2,) [px]
    radius_px: float  # radius of the circle of the same area [px]
    cov_px: FloatArray  # covariance of the centre, shape (2, 2) [px²]
    radius_sigma_px: float  # 1-sigma of the radius [px]
    visible: float  # share of the outline that is not occluded
    uneven: float  # share of the outline with a background too uneven to show the edge
    outlier_share: float  # share of the fit's weights where the outline leaves the ellipse in whole arcs
    roughness: float = (
        0.0  # deviation of the limb from the ellipse, in variances of its samples; 0 if it was not checked
    )
    blur_px: float = ContourSettings.usual_blur_px  # blur of the limb (1-sigma) [px]


@dataclass(frozen=True, slots=True)
class _Edges:
    """Edge of the ball on each ray, in the frame in which the outline is a circle around the rough centre."""

    rays: FloatArray  # cosine and sine of the rays' directions, and 1, shape (n, 3)
    distance_px: FloatArray  # distance of the edge from the rough centre, shape (n,) [px]
    weight: FloatArray  # weight of each ray, 0..1, shape (n,); 0 if the ray shows no edge
    covered: BoolArray  # mask (n,) of rays on which something else shows just inside the rough outline
    # mask (n,) of rays whose background is too uneven to rule out that an edge elsewhere is the ball's
    uneven: BoolArray


@dataclass(frozen=True, slots=True)
class _Fit:
    """Circle through the edges."""

    edges: _Edges
    solution: FloatArray  # shift of its centre and its radius, shape (3,) [px]
    inverse: FloatArray  # inverse normal matrix (3, 3), without the noise's variance
    residual: FloatArray  # of each ray, shape (n,) [px]
    used: FloatArray  # weight of each ray, 0..1, shape (n,)
    rejected: BoolArray  # mask (n,) of rays whose edge is too far off


def fit_outline(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray
) -> Outline | None:
    """Refine a rough circle to the outline of the ball, by coverage; return None if there is no outline near it.

    Args:
        image: BGR, shape (height, width, 3), grey levels.
        centre_px: rough centre (2,), in the pixel coordinates of `image` [px].
        radius_px: rough radius [px], accurate to about a fifth.
        shape: the ellipse's shape (2, 2), see `sphere.Ellipse`.
    """
    fit, moved_px = _step(image, gate, centre_px, radius_px, shape, _Settings.narrow_px)
    windows_px = (_Settings.narrow_px, _Settings.narrow_px)
    if moved_px > _Settings.rough_px:
        fit, moved_px = None, _Settings.rough_px
        windows_px = (_Settings.wide_px, *windows_px)  # a fit in the wide ring is not final
    for window_px in windows_px:
        if moved_px < _Settings.settled_px:
            break
        if fit is not None:
            centre_px, radius_px = centre_px + shape @ fit.solution[:2], float(fit.solution[2])
        fit, moved_px = _step(image, gate, centre_px, radius_px, shape, window_px, has_consensus=fit is not None)
        if moved_px > max(2.0, 0.5 * radius_px):
            return None
        if window_px == _Settings.wide_px:
            moved_px = _Settings.rough_px
    return None if fit is None else _outline(fit, centre_px, shape)


def refine_outline(
    image: Float32Array, gate: Gate, rough: Outline, shape: FloatArray, blur_px: float
) -> Outline | None:
    """Refine an outline's centre, radius and covariance by the limb; return None if there is no ball's limb.

    Args:
        blur_px: rough blur of the limb, from which the fit starts [px].
    """
    fitted = fit_contour(image, gate, rough.centre_px, rough.radius_px, shape, blur_px)
    if fitted is None:
        return None
    if fitted.aliased:
        return replace(rough, blur_px=fitted.blur_px)
    moved_px = fitted.centre_px - rough.centre_px
    cov_px = fitted.cov_px + _Settings.floor_px**2 * np.eye(2)
    contradiction = float(moved_px @ np.linalg.solve(cov_px + rough.cov_px, moved_px))
    if contradiction > _Settings.largest_contradiction**2:
        cov_px += np.outer(moved_px, moved_px)
    return replace(
        rough,
        centre_px=fitted.centre_px,
        radius_px=fitted.radius_px,
        cov_px=cov_px,
        radius_sigma_px=fitted.radius_sigma_px,
        roughness=fitted.roughness,
        blur_px=fitted.blur_px,
    )


def _step(
    image: Float32Array,
    gate: Gate,
    centre_px: FloatArray,
    radius_px: float,
    shape: FloatArray,
    window_px: float,
    *,
    has_consensus: bool = False,
) -> tuple[_Fit | None, float]:
    """Fit a circle in a ring of half-width `window_px` about another one; return it and its shift [px].

    Args:
        has_consensus: True if most points agree on the other circle.
    """
    edges = _find_edges(image, gate, centre_px, radius_px, shape, min(window_px, 0.6 * radius_px))
    consensus = np.array([0.0, 0.0, radius_px]) if has_consensus else None
    fit = None if edges is None else _fit(edges, consensus)
    if fit is None:
        return None, math.inf
    u, v, radius = fit.solution.tolist()
    return fit, math.hypot(u, v) + abs(radius - radius_px)


def _find_edges(
    image: Float32Array, gate: Gate, centre_px: FloatArray, radius_px: float, shape: FloatArray, half_px: float
) -> _Edges | None:
    rays = rays_round(radius_px)
    cells = max(2, round(2 * half_px / _Settings.step_px))
    step = 2 * half_px / cells
    inner = 0.3 * radius_px + (0.7 * radius_px - half_px) * _Settings.inner
    ring = radius_px - half_px + (np.arange(cells) + 0.5) * step
    outer = (
        radius_px + half_px + (np.arange(round(_Settings.background_px / _Settings.step_px)) + 0.5) * _Settings.step_px
    )
    radii = np.asarray(np.concatenate([inner, ring, outer]), np.float64)
    samples = sample(image, centre_px, rays, radii, shape)
    inside = samples[:, : len(inner)]
    colour = ball_colour(inside, gate)
    if colour is None:
        return None
    rim_amount = gate.amount(inside[:, -2:])
    level = np.maximum(mean_of_three(0.5 * (rim_amount[:, 0] + rim_amount[:, 1])), 0.0)
    covered = level < _Settings.min_level * median(level)
    channels = np.stack(cast("list[Float32Array]", cv2.split(samples)))[..., len(inner) :]
    background = mean_of_three(channels[..., cells:].mean(axis=2).T)
    direction, separation = _discriminant(level, colour, background, gate.shading_sigma)
    measured = (separation > _Settings.min_separation**2) & ~covered
    direction /= np.where(measured, separation, 1.0)[:, None]
    # The share of ball in each sample: 1 on the ball, 0 on the background.
    projected = (channels - background.T[..., None].astype(np.float32)) * direction.T[..., None].astype(np.float32)
    coverage = projected.sum(axis=0)
    distance = radius_px - half_px + step * coverage[:, :cells].sum(axis=1, dtype=np.float64)
    unevenness_px = half_px * np.sqrt(np.square(coverage[:, cells:]).mean(axis=1, dtype=np.float64))
    weight = measured / (1.0 + (unevenness_px / _Settings.edge_sigma_px) ** 2)
    return _Edges(rays, distance, weight, covered, ~measured | (unevenness_px > _Settings.uneven_px))


def _discriminant(
    level: FloatArray, colour: FloatArray, background: FloatArray, shading_sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Compute Fisher's linear discriminant between ball and background, ray by ray.

    The ball is `level · colour`, with a covariance of (σ_s · level)² along `colour` and of σ_c² in all channels.

    Args:
        level: the ball's level at the limb, shape (n,).
        background: shape (n, 3).

    Returns:
        The direction in colour space (n, 3), and the squared separation along it (n,) in sigmas.
    """
    difference = level[:, None] * colour - background
    along = (shading_sigma * level) ** 2
    # Inverse of σ_c² I + along · colour colourᵀ by Sherman and Morrison.
    share = along * (difference @ colour) / (_Settings.channel_sigma**2 + along * (colour @ colour))
    direction = (difference - share[:, None] * colour) / _Settings.channel_sigma**2
    return direction, np.einsum("nc,nc->n", direction, difference)


def _fit(edges: _Edges, consensus: FloatArray | None) -> _Fit | None:
    """Fit a circle by least squares, leaving out points that are too far off in turn.

    Args:
        consensus: circle (3,) [px] that most points agree on; None to search for it.
    """
    weight = (
        _least_median_weights(edges)
        if consensus is None
        else _weights_near(edges, edges.distance_px - edges.rays @ consensus)
    )
    fit: _Fit | None = None
    for _ in range(3):
        fitted = None if np.count_nonzero(weight) < len(weight) // 2 else fit_circle(edges.distance_px, weight)
        if fitted is None:
            return None
        residual = edges.distance_px - edges.rays @ fitted[0]
        inlier_weight = _weights_near(edges, residual)
        fit = _Fit(edges, *fitted, residual, weight, inlier_weight == 0)
        if np.array_equal(weight, inlier_weight):
            break
        weight = inlier_weight
    return fit if fit is not None and fit.solution[2] > 0 else None


def _weights_near(edges: _Edges, residual: FloatArray) -> FloatArray:
    """Return the points' weights (n,), with 0 for those whose residual (n,) [px] is large for most."""
    deviations_px = np.abs(residual[edges.weight > 0])
    if not len(deviations_px):
        return edges.weight
    spread = 1.4826 * median(deviations_px)
    gate = min(max(_Settings.gate_sigmas * spread, _Settings.min_gate_px), _Settings.narrow_px)
    return np.where(np.abs(residual) < gate, edges.weight, 0.0)


def _outline(fit: _Fit, centre_px: FloatArray, shape: FloatArray) -> Outline:
    edges, residual, radius_px = fit.edges, fit.residual, float(fit.solution[2])
    inverse = residual_spectrum(np.sqrt(fit.used) * residual, radius_px).once_round_variance() * fit.inverse
    # An object in front of a ball moves its edge inwards; one of its colour behind it moves it outwards.
    rejected = fit.rejected & ~edges.uneven
    hidden = edges.covered | (rejected & (residual < 0))
    return Outline(
        centre_px=centre_px + shape @ fit.solution[:2],
        radius_px=radius_px,
        cov_px=shape @ inverse[:2, :2] @ shape + _Settings.floor_px**2 * np.eye(2),
        radius_sigma_px=math.sqrt(inverse[2, 2]),
        visible=1.0 - np.count_nonzero(hidden) / len(hidden),
        uneven=np.count_nonzero(edges.uneven | (rejected & ~hidden)) / len(hidden),
        outlier_share=_arc_outlier_share(edges.weight, residual, max(0.35, _Settings.off_share * radius_px)),
    )


def _arc_outlier_share(weight: FloatArray, residual: FloatArray, limit_px: float) -> float:
    """Return the share of the weights (n,) where the residuals (n,) [px], averaged over an arc, exceed edge noise.

    Noise and aliasing change from ray to ray; an object that covers part of the ball moves the edge in a whole arc.
    """
    half = round(len(weight) / (2 * _Settings.arcs))
    clipped = weight * np.clip(residual, -_Settings.narrow_px, _Settings.narrow_px)
    arc_residuals, arc_weights = _arc_sums(clipped, half), _arc_sums(weight, half)
    return float(weight @ (np.abs(arc_residuals) > limit_px * arc_weights) / weight.sum())


def _arc_sums(values: FloatArray, half: int) -> FloatArray:
    """Sum each of `values` (n,) and its `half` neighbours on both sides, along the closed axis."""
    sums = np.concatenate([[0.0], np.cumsum(np.concatenate([values[-half:], values, values[:half]]))])
    return sums[2 * half + 1 :] - sums[: -2 * half - 1]


def _least_median_weights(edges: _Edges) -> FloatArray:
    """Return the points' weights (n,), with 0 for those far from the circle that most points agree on.

    Rousseeuw's least median of squares, over circles through the means of three arcs. Occlusions hide whole arcs, up to
    nearly half of the outline, and all of them pull inwards: plain least squares would follow them.
    """
    measured = np.flatnonzero(edges.weight > 0)
    if len(measured) < 2 * _Settings.arcs:
        return edges.weight
    points = np.column_stack([edges.rays[measured], edges.distance_px[measured]])
    begins = np.arange(_Settings.arcs) * len(measured) // _Settings.arcs
    means = (np.add.reduceat(points, begins) / np.diff(begins, append=len(measured))[:, None])[_TRIPLES]
    measured = measured[:: max(1, len(measured) // _Settings.enough_rays)]
    circles = np.linalg.solve(means[..., :3] + 1e-9 * np.eye(3), means[..., 3:])[..., 0]
    deviations_px = np.abs(edges.distance_px[measured] - circles @ edges.rays[measured].T)
    middle = len(measured) // 2
    spread = np.partition(deviations_px, middle, axis=1)[:, middle]
    best = int(np.argmin(spread))
    gate = min(max(_Settings.gate_sigmas * 1.4826 * float(spread[best]), _Settings.min_gate_px), _Settings.narrow_px)
    return np.where(np.abs(edges.distance_px - edges.rays @ circles[best]) < gate, edges.weight, 0.0)
