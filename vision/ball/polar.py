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


def rays_round(radius_px: float) -> FloatArray:
    """Return rays about a pixel apart on the outline, as rows (cos, sin, 1) of their angles, shape (n, 3).

    These are the derivatives of a circle's points along the rays by its centre and its radius, too.
    """
    return _rays(min(max(round(2 * math.pi * radius_px), 24), 400))


@lru_cache(maxsize=400)
def _rays(count: int) -> FloatArray:
    angles = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    return frozen_array(np.stack([np.cos(angles), np.sin(angles), np.ones(count)], axis=1))


def sample(
    image: Float32Array, centre_px: FloatArray, rays: FloatArray, radii: FloatArray, shape: FloatArray
) -> Float32Array:
    """Sample `image` on every ray (rows) and at every radius (columns) of the ellipse's own polar coordinates."""
    directions = rays[:, :2] @ shape
    at = (centre_px + directions[:, None, :] * radii[:, None]).astype(np.float32)
    samples = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return cast(Float32Array, samples)


def ball_colour(inside: Float32Array, gate: Gate) -> FloatArray | None:
    """Return the ball's colour (3,) per unit of its amount; the median excludes highlights."""
    samples = inside.reshape(-1, 3)
    amount = gate.amount(samples)
    coloured = amount > 1.0
    if np.count_nonzero(coloured) < len(amount) // 2:
        return None
    relative = samples[coloured] / amount[coloured, None]
    middle = len(relative) // 2
    return np.partition(relative, middle, axis=0)[middle].astype(np.float64)


def mean_of_three(values: NDArray[np.floating]) -> FloatArray:
    """Return the mean over three neighbours along the closed first axis."""
    wrapped = np.empty((len(values) + 2, *values.shape[1:]))
    wrapped[0], wrapped[1:-1], wrapped[-1] = values[-1], values, values[0]
    sums = wrapped[:-2] + wrapped[1:-1]
    sums += wrapped[2:]
    sums /= 3.0
    return sums


def median(values: NDArray[np.floating]) -> float:
    """Return the upper median; NumPy's own costs ten times as much for the few values here."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
