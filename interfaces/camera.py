"""Ideal pinholes: a rectified stereo pair side by side, or one camera alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .records import FloatArray

# The largest sensors have 15,000 pixels a side; what is worked on grows with the square of it.
LARGEST_SIDE_PX = 16384


@dataclass(frozen=True, slots=True)
class StereoCalibration:
    """Calibration of one or two rectified eyes.

    The measurement frame is the left optical frame (x right, y down, z forward). A single camera is the left eye of a
    pair without a right one: its baseline is 0.

    The right eye is at (+baseline_m, 0, 0) in the left optical frame and looks the same way, so that
    u_left = cx + f·x/z, u_right = cx + f·(x − baseline)/z and v = cy + f·y/z in both.

    Attributes:
        focal_px: focal length f of both eyes [px].
        principal_point_px: (cx, cy) of both eyes; integer coordinates are pixel centres.
        baseline_m: distance of the eyes [m]; 0 for a single camera.
        image_size_px: (width, height).
        pixel_sigma: 1-sigma of a marker centre's image coordinates, per coordinate [px].
    """

    focal_px: float
    principal_point_px: tuple[float, float]
    baseline_m: float
    image_size_px: tuple[int, int]
    pixel_sigma: float = 0.2

    @property
    def is_stereo(self) -> bool:
        """True if there are two eyes."""
        return self.baseline_m > 0.0

    @property
    def eyes_m(self) -> FloatArray:
        """Positions of the eyes in the left optical frame (eyes, 3) [m]."""
        return np.array([[0.0, 0.0, 0.0], [self.baseline_m, 0.0, 0.0]])[: 2 if self.is_stereo else 1]

    def project(self, x: FloatArray) -> FloatArray:
        """Project points (..., 3) [m] in the left optical frame to pixels (..., 4), as (ul, vl, ur, vr) [px]."""
        cx, cy = self.principal_point_px
        scale = self.focal_px / x[..., 2]
        u_left, v = cx + scale * x[..., 0], cy + scale * x[..., 1]
        return np.stack([u_left, v, u_left - scale * self.baseline_m, v], axis=-1)
