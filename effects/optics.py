"""Model the cameras' own errors: the points that a stereo pair reports if its lenses differ from the calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray


@dataclass(frozen=True, slots=True)
class Optics:
    """Differences of the true cameras from the calibration."""

    scale_error: float = 0.0  # measured over true distances, minus one: the nominal baseline over the true one
    focal_error: float = 0.0  # true over nominal focal length, minus one
    # k1, k2: radial distortion left in the images: a ray (x, y, 1) is seen at (x, y)·(1 + k1·r² + k2·r⁴) with r² = x² +
    # y²
    k1: float = 0.0
    k2: float = 0.0

    def __add__(self, other: Optics) -> Optics:
        return Optics(
            self.scale_error + other.scale_error,
            self.focal_error + other.focal_error,
            self.k1 + other.k1,
            self.k2 + other.k2,
        )

    @property
    def inside(self) -> bool:
        """True if the errors require a stereo calibration."""
        return (self.focal_error, self.k1, self.k2) != (0.0, 0.0, 0.0)

    def reported(self, x: FloatArray, calibration: StereoCalibration | None) -> FloatArray:
        """Return points (n, 3) [m] by the nominal calibration, of points (n, 3) [m] in the true left optical frame.

        A stereo pair triangulates. A single camera derives the depth from the marker's size, whose error is
        `scale_error`.
        """
        if not self.inside:
            return x * (1.0 + self.scale_error)
        assert calibration is not None
        left, right = self.rays(x, calibration)
        if not calibration.is_stereo:
            depth = x[:, 2] * (1.0 + self.scale_error) / self._magnified(x)
            return np.column_stack([left * depth[:, None], depth])
        depth = calibration.baseline_m / (left[:, 0] - right[:, 0])
        return np.stack([left[:, 0] * depth, 0.5 * (left[:, 1] + right[:, 1]) * depth, depth], axis=1)

    def rays(self, x: FloatArray, calibration: StereoCalibration) -> tuple[FloatArray, FloatArray]:
        """Return the rays on which both cameras see points (n, 3) [m]: (n, 2) each, by the nominal calibration.

        A ray (a, b) runs along (a, b, 1) in the camera's own optical frame.
        """
        true_baseline = calibration.baseline_m / (1.0 + self.scale_error)
        left = self._seen(x[:, 0] / x[:, 2], x[:, 1] / x[:, 2])
        right = self._seen((x[:, 0] - true_baseline) / x[:, 2], x[:, 1] / x[:, 2])
        return left, right

    def _magnified(self, x: FloatArray) -> FloatArray:
        """Return the magnification (n,) of small objects at x (n, 3) [m] in one camera, from which it infers depth.

        Distortion magnifies differently along the radius and across it: this is the geometric mean.
        """
        r2 = np.square(x[:, :2] / x[:, 2:]).sum(axis=1)
        across = 1.0 + r2 * (self.k1 + self.k2 * r2)
        along = 1.0 + r2 * (3.0 * self.k1 + 5.0 * self.k2 * r2)
        return (1.0 + self.focal_error) * np.sqrt(across * along)

    def _seen(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the nominal rays (n, 2) of points that lie on true rays (x, y, 1)."""
        r2 = x * x + y * y
        factor = (1.0 + self.focal_error) * (1.0 + r2 * (self.k1 + self.k2 * r2))
        return np.stack([x * factor, y * factor], axis=1)
