"""The true stereo pair, and positions measured with its description."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .arms import Eyes
from .arrays import BoolArray, FloatArray

PIXELS_PER_FIX = 4


@dataclass(frozen=True)
class TrueEyes:
    """The true camera pair.

    Attributes:
        focal_px, baseline_m: true values.
        k1, k2: Brown's radial distortion of either lens, in units of the normalised image.
        vergence_rad: the right eye turned about its y axis.
    """

    described: Eyes
    focal_px: float
    baseline_m: float
    k1: float = 0.0
    k2: float = 0.0
    vergence_rad: float = 0.0

    @classmethod
    def as_described(cls, eyes: Eyes) -> TrueEyes:
        """Return a camera pair that is exactly as described."""
        return cls(eyes, eyes.focal_px, eyes.baseline_m)

    def project(self, x: FloatArray) -> FloatArray:
        """Return pixel centres ul, vl, ur, vr [px] of points in the left optical frame [m], shape (n, 4)."""
        right = (x - np.array([self.baseline_m, 0.0, 0.0])) @ Rotation.from_euler("y", self.vergence_rad).as_matrix()
        return np.hstack([self._pixels(x), self._pixels(right)])

    def _pixels(self, x: FloatArray) -> FloatArray:
        ideal = x[:, :2] / x[:, 2:]
        r2 = np.sum(ideal**2, axis=1, keepdims=True)
        return self.focal_px * ideal * (1.0 + self.k1 * r2 + self.k2 * r2**2) + self.described.principal_point_px


def triangulate(eyes: Eyes, pixels: FloatArray) -> FloatArray:
    """Return positions (n, 3) [m] in the left optical frame of pixel centres (n, 4), by the pair's description."""
    ul, vl, ur, vr = pixels.T
    cu, cv = eyes.principal_point_px
    per_pixel = eyes.baseline_m / (ul - ur)
    return np.column_stack(
        [(ul - cu) * per_pixel, (0.5 * (vl + vr) - cv) * per_pixel, np.full(len(ul), eyes.focal_px) * per_pixel]
    )


def covariance(eyes: Eyes, pixels: FloatArray) -> FloatArray:
    """Return the covariance [m²] of triangulated positions for the noise of pixel centres (n, 4), shape (n, 3, 3)."""
    ul, _, ur, _ = pixels.T
    x = triangulate(eyes, pixels)
    disparity, per_pixel = ul - ur, eyes.baseline_m / (ul - ur)
    jacobian = np.zeros((len(x), 3, PIXELS_PER_FIX))
    jacobian[:, :, 0] = -x / disparity[:, None]
    jacobian[:, :, 2] = x / disparity[:, None]
    jacobian[:, 0, 0] += per_pixel
    jacobian[:, 1, 1] = jacobian[:, 1, 3] = 0.5 * per_pixel
    return eyes.pixel_sigma**2 * jacobian @ jacobian.transpose(0, 2, 1)


def in_view(eyes: Eyes, x: FloatArray, margin_px: float, nearest_m: float = 0.15) -> BoolArray:
    """Return a mask (n,) of the points in the left optical frame [m] that both cameras see with this margin."""
    width, height = eyes.image_size_px
    front = x[:, 2] > nearest_m
    pixels = TrueEyes.as_described(eyes).project(np.where(front[:, None], x, [0.0, 0.0, 1.0]))
    inside = np.ones(len(x), dtype=bool)
    for column, size in enumerate((width, height, width, height)):
        inside &= (pixels[:, column] > margin_px) & (pixels[:, column] < size - margin_px)
    return front & inside
