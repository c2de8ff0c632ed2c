"""What was measured, and how exactly: positions with the shape of their noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from effects import Motion
from interfaces.camera import StereoCalibration
from interfaces.recording import Recording
from interfaces.records import FloatArray
from interfaces.robot import RobotDescription

IntArray = NDArray[np.intp]

# Where nothing is said of the noise it is taken as round; its size is estimated in any case [m].
_UNIT_M = 1e-3
# How far outliers may lie: this times the spread of what was measured.
_OUTLIER_SPREAD = 2.0
# A measured variance is never taken to be smaller than this share of the median one.
_SMALLEST_VARIANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Observations:
    """Measured positions over a motion.

    Attributes:
        motion: what the encoders read.
        x: measured positions (n, 3) [m].
        whitening: (n, 3, 3): W (x - truth) has equal and independent noise in all coordinates, but for one factor.
    """

    motion: Motion
    x: FloatArray
    whitening: FloatArray

    @classmethod
    def of(cls, recording: Recording, robot: RobotDescription) -> Observations:
        """The positions of a recording; the shape of their noise is its own, else the stereo camera's, else round."""
        if recording.cov is not None:
            covariances = recording.cov
        elif robot.calibration is not None:
            covariances = stereo_covariances(recording.x, robot.calibration)
        else:
            covariances = np.broadcast_to(_UNIT_M**2 * np.eye(3), (len(recording), 3, 3))
        return cls(Motion.of(recording), recording.x, _whitening(covariances))

    def __len__(self) -> int:
        return len(self.x)

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Columns (n, 3, p) [m] in units of the noise."""
        return self.whitening @ columns

    def residuals(self, predicted: FloatArray) -> FloatArray:
        """Measured minus predicted (n, 3), in units of the noise."""
        return np.einsum("nij,nj->ni", self.whitening, self.x - predicted)

    @cached_property
    def outlier_density(self) -> FloatArray:
        """Logarithm of the density (n,) of a fix that is not the marker, per unit volume of whitened space."""
        spread = _OUTLIER_SPREAD * np.linalg.norm(self.x - np.median(self.x, axis=0), axis=1).max()
        volume = 4.0 / 3.0 * np.pi * max(float(spread), _UNIT_M) ** 3
        return -np.log(volume) - np.linalg.slogdet(self.whitening)[1]

    def select(self, rows: NDArray[np.bool_]) -> Observations:
        """Some of the rows (n,)."""
        motion = self.motion
        t = None if motion.t is None else motion.t[rows]
        return Observations(Motion(motion.q[rows], t, motion.segment[rows]), self.x[rows], self.whitening[rows])


def stereo_covariances(x: FloatArray, calibration: StereoCalibration) -> FloatArray:
    """Covariance (n, 3, 3) [m²] of triangulated points (n, 3) whose image coordinates are `pixel_sigma` uncertain."""
    f, b = calibration.focal_px, calibration.baseline_m
    depth = np.maximum(np.abs(x[:, 2]), 1e-3)
    by_left, by_right, by_row = np.zeros((3, len(x), 3))
    # z = f b / (ul - ur), x = (ul - cx) z / f, y = (v - cy) z / f with v the mean of both rows
    by_left[:, 2] = -(depth**2) / (f * b)
    by_right[:, 2] = -by_left[:, 2]
    for change in (by_left, by_right):
        change[:, 0] = x[:, 0] / depth * change[:, 2]
        change[:, 1] = x[:, 1] / depth * change[:, 2]
    by_left[:, 0] += depth / f
    by_row[:, 1] = np.sqrt(0.5) * depth / f
    covariance = sum(np.einsum("ni,nj->nij", change, change) for change in (by_left, by_right, by_row))
    return calibration.pixel_sigma**2 * np.asarray(covariance)


def _whitening(covariances: FloatArray) -> FloatArray:
    floor = _SMALLEST_VARIANCE * float(np.median(np.trace(covariances, axis1=1, axis2=2))) / 3.0
    if not floor > 0.0:
        floor = _UNIT_M**2
    return np.linalg.inv(np.linalg.cholesky(covariances + floor * np.eye(3)))
