"""Optimal linear filters for the position at which a ray of samples leaves a ball.

Samples at t [px] along a ray, t = 0 at the assumed outline, are

    ball(t) · S(t) + background(t) · (1 − S(t)) + shift · contrast · g(t) + noise,

with S the blurred step from 1 on the ball to 0 beyond it and g its slope. Unknown terms of both filter and likelihood
have a Gaussian process as prior, in units of the noise. The background's level is free, its slope none or moderate, and
its texture a random walk starting at the outline. In its own colour the ball's level and its shading are free (a
sphere's depends on the normal's part along the ray, √(1 − ρ²)). Orthogonal to that colour a ball shows only gloss,
which fades towards the limb. The rougher the background, the less a filter trusts samples far from the edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .colour import Float32Array
from .settings import ContourSettings as _Settings


@dataclass(frozen=True, slots=True)
class Filters:
    """One filter for each of k textures of the background, over m samples of a ray in units of their noise."""

    # matrix applied to samples (n, m), shape (m, l + 3k). The squares of the first l columns' results make the
    # likelihoods. Then there are k filters for the edge's shift times the contrast and its information, k for the
    # blur's error times the same, and k for the contrast, ball minus background at the edge.
    matrix: Float32Array
    groups: Float32Array  # 1 where a square belongs to a texture, else 0, shape (l, k)
    log_ratio: Float32Array  # logarithms of the covariances' determinants less that of the first texture, shape (k,)
    information: FloatArray  # inverse variances of shift and blur for a contrast of 1, shape (2, k) [1/px²]

    def apply(self, samples: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return the textures' log-likelihoods (n, k) for samples (n, m), and the filters' results (n, 3, k)."""
        found = samples @ self.matrix
        squares, count = np.square(found[:, : len(self.groups)]), self.information.shape[1]
        return 0.5 * (squares @ self.groups - self.log_ratio), found[:, len(self.groups) :].reshape(-1, 3, count)


def sample_offsets(radius_px: float, blur_px: float) -> FloatArray:
    """Return the sample positions along a ray, shape (m,) [px] from the outline.

    A small ball has fewer samples inside; a wide blur needs more on both sides.
    """
    wider = max(1.0, blur_px / _Settings.usual_blur_px)
    inside = min(
        round(_Settings.inside_px * wider / _Settings.step_px), max(3, round(0.9 * radius_px / (2 * _Settings.step_px)))
    )
    outside = round(_Settings.outside_px * wider / _Settings.step_px)
    return np.arange(-inside + 0.5, outside) * _Settings.step_px


def edge_filters(radius_px: float, blur_px: float) -> tuple[Filters, Filters]:
    """Return the filters along the ball's own colour and orthogonal to it, at `sample_offsets(radius_px, blur_px)`.

    Radius and blur are rounded to a few per cent, so that the filters of a tracked ball are computed only once.
    """
    at = tuple(sample_offsets(radius_px, blur_px).tolist())
    radius_px, blur_px = _rounded(radius_px, 10), _rounded(blur_px, 20)
    return _filters(at, radius_px, blur_px, True), _filters(at, radius_px, blur_px, False)


def _rounded(value: float, steps: int) -> float:
    return math.exp(round(steps * math.log(value)) / steps)


@lru_cache(maxsize=512)
def _filters(at: tuple[float, ...], radius_px: float, blur_px: float, own_colour: bool) -> Filters:
    t = np.array(at)
    ball = np.array([0.5 * math.erfc(x / (blur_px * math.sqrt(2.0))) for x in at])
    slope = np.exp(-0.5 * (t / blur_px) ** 2) / (blur_px * math.sqrt(2.0 * math.pi))
    wider = slope * t / blur_px
    beyond = 1.0 - ball
    # The ball's level at t = 0 and how it falls towards the limb.
    level, fall = (_Settings.free, _Settings.free) if own_colour else (_Settings.across, _Settings.across)
    normal = _blurred_normal(t, radius_px, blur_px)
    gloss = (_Settings.gloss * np.clip(-t - _Settings.edge_blurs * blur_px, 0.0, None) ** 2) ** 2
    known = np.eye(len(t)) + np.diag(gloss) + level * np.outer(ball, ball) + fall * np.outer(normal, normal)
    # Covariance of a random walk from 0 to both sides.
    walk = 0.5 * (np.abs(t)[:, None] + np.abs(t) - np.abs(t[:, None] - t))
    rows: list[tuple[FloatArray | float, ...]] = []
    for roughness, slope_variance in _Settings.textures:
        background = _Settings.free + slope_variance * np.outer(t, t) + roughness**2 * walk
        cov: FloatArray = (known + np.outer(beyond, beyond) * background).astype(np.float64)
        shift, shift_information = _best_filter(cov + _Settings.blur * np.outer(wider, wider), slope)
        widening, widening_information = _best_filter(cov + _Settings.free * np.outer(slope, slope), wider)
        cov += _Settings.blur * np.outer(wider, wider) + _Settings.free * np.outer(slope, slope)
        precision: FloatArray = np.linalg.inv(cov).astype(np.float64)
        contrast = (level * ball - _Settings.free * beyond) @ precision
        log_determinant = float(np.linalg.slogdet(cov)[1])
        rows.append((precision, log_determinant, shift, widening, contrast, shift_information, widening_information))
    precisions, log_determinants, *finding, shift_informations, widening_informations = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    # The rougher the texture, the larger the covariance: precisions differ by a sum of squares.
    roots = [_root(precisions[0] - precision) for precision in precisions[1:]]
    widths = [0, *(root.shape[1] for root in roots)]
    return Filters(
        np.hstack([*roots, *(filter.T for filter in finding)]).astype(np.float32),
        np.repeat(np.eye(len(widths), dtype=np.float32), widths, axis=0),
        (log_determinants - log_determinants[0]).astype(np.float32),
        np.stack([shift_informations, widening_informations]),
    )


def _root(matrix: FloatArray) -> FloatArray:
    """Return a (m, l) whose product with its transpose is a positive semidefinite matrix (m, m)."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    kept = values > np.sqrt(np.finfo(np.float64).eps)  # less changes likelihoods by less than thousandths
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]), np.float64)


def _best_filter(cov: FloatArray, signal: FloatArray) -> tuple[FloatArray, float]:
    """Return the minimum-variance linear filter (m,) for the amplitude of `signal` (m,), multiplied by its information.

    Return the information too.
    """
    weighted: FloatArray = np.linalg.solve(cov, signal).astype(np.float64)
    return weighted, float(signal @ weighted)


def _blurred_normal(t: FloatArray, radius_px: float, blur_px: float) -> FloatArray:
    """Return the line-of-sight component of a sphere's normal, 0 outside the sphere, blurred as in the image."""
    reach = 4.0 * blur_px
    fine = np.arange(t[0] - reach, t[-1] + reach, _Settings.fine_px)
    normal = np.sqrt(np.clip(1.0 - (1.0 + np.minimum(fine, 0.0) / radius_px) ** 2, 0.0, None))
    weight = np.exp(-0.5 * ((t[:, None] - fine) / blur_px) ** 2)
    return weight @ normal / weight.sum(axis=1)
