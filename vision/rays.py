"""A ball's image along rays from its middle."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np

from interfaces.records import FloatArray

from .colour import Float32Array, Gate


def ray_angles(radius_px: float) -> FloatArray:
    """Directions [rad] of rays about a pixel apart on the outline, shape (n,)."""
    count = int(np.clip(round(2 * np.pi * radius_px), 24, 400))
    return np.linspace(0.0, 2 * np.pi, count, endpoint=False)


def sample_rays(
    image: Float32Array,
    centre_px: FloatArray,
    angles: FloatArray,
    radii_px: FloatArray,
    shape: FloatArray,
    interpolation: int = cv2.INTER_LINEAR,
) -> Float32Array:
    """`image` at every angle (rows) and radius (columns) of the ellipse's own polar coordinates."""
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ shape
    at = (centre_px + directions[:, None, :] * radii_px[:, None]).astype(np.float32)
    samples = cv2.remap(image, at[..., 0], at[..., 1], interpolation, borderMode=cv2.BORDER_REPLICATE)
    return cast(Float32Array, samples)


def ball_colour(inside: Float32Array, gate: Gate) -> FloatArray | None:
    """The ball's colour (3,) per unit of its amount; the median leaves highlights out. None where there is no ball."""
    samples = inside.reshape(-1, 3)
    amount = gate.amount(samples)
    coloured = amount > 1.0
    if np.count_nonzero(coloured) < len(amount) // 2:
        return None
    ratios = samples[coloured] / amount[coloured, None]
    middle = len(ratios) // 2
    return np.partition(ratios, middle, axis=0)[middle].astype(np.float64)


def median(values: FloatArray) -> float:
    """The upper median; NumPy's own costs ten times as much for the few values here."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
