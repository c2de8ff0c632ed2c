"""Images sampled along rays from a ball's centre."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray, frozen_array

from .colour import Float32Array, Gate
from .settings import OutlineSettings as _Settings


def rays_round(radius_px: float) -> FloatArray:
    """Return rays about a pixel apart on the outline, as rows (cos, sin, 1) of their angles, shape (n, 3).

    These are also the derivatives of a circle's points along the rays by its centre and its radius.
    """
    return _rays(min(max(round(2 * math.pi * radius_px), 24), 400))[0]


@lru_cache(maxsize=400)
def _rays(count: int) -> tuple[FloatArray, FloatArray]:
    """Return the rays and the products of their columns (n, 6)."""
    angles = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    rays = np.stack([np.cos(angles), np.sin(angles), np.ones(count)], axis=1)
    rows, columns = np.triu_indices(3)
    return frozen_array(rays), frozen_array(rays[:, rows] * rays[:, columns])


def fit_circle(distance_px: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Fit shift of the centre and radius (3,) [px] to distances (n,) on `rays_round` by weighted least squares.

    Return them and the inverse normal matrix (3, 3); None if the weights (n,) determine too little.
    """
    rays, products = _rays(len(weight))
    # By hand: NumPy's own routines cost more than the arithmetic.
    a, b, c, d, e, f = (weight @ products).tolist()
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * A + b * B + c * C
    if not determinant > np.finfo(np.float64).eps * (a + d + f) ** 3:
        return None
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    inverse = np.array([[A, B, C], [B, D, E], [C, E, F]]) / determinant
    return inverse @ ((weight * distance_px) @ rays), inverse


def sample(
    image: Float32Array, centre_px: FloatArray, rays: FloatArray, radii: FloatArray, shape: FloatArray
) -> Float32Array:
    """Sample `image` on every ray (rows) and at every radius (columns) of the ellipse's own polar coordinates."""
    positions = np.multiply.outer(shape @ rays[:, :2].T, radii)
    positions += centre_px[:, None, None]
    u, v = positions.astype(np.float32)
    return cast(Float32Array, cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def ball_colour(inside: Float32Array, gate: Gate) -> FloatArray | None:
    """Return the ball's colour (3,) per unit of its amount; the median excludes highlights."""
    samples = inside[:: max(1, len(inside) // _Settings.enough_rays)].reshape(-1, 3)
    amount = gate.amount(samples)
    coloured = amount > 1.0
    if np.count_nonzero(coloured) < len(amount) // 2:
        return None
    relative = samples.compress(coloured, axis=0) / amount.compress(coloured)[:, None]
    middle = len(relative) // 2
    return np.partition(relative, middle, axis=0)[middle].astype(np.float64)


def mean_of_three(values: NDArray[np.floating]) -> FloatArray:
    """Return the mean over three neighbours along the closed first axis."""
    wrapped = np.concatenate([values[-1:], values, values[:1]])
    return np.asarray((wrapped[:-2] + wrapped[1:-1] + wrapped[2:]) / 3.0, np.float64)


def median(values: NDArray[np.floating]) -> float:
    """Return the upper median; NumPy's own costs ten times as much for the few values here."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
