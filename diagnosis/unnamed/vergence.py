"""Model a stereo pair whose cameras are rotated relative to each other (vergence), which no named effect covers."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray


class _Settings:
    step_rad = 1e-5  # step for numerical derivatives [rad]
    rounds = 8  # fixed-point iterations to invert the distortion


def reported(x: FloatArray, calibration: StereoCalibration, turn: FloatArray) -> FloatArray:
    """Return the triangulated points (n, 3) [m] of true points (n, 3) [m] in the left optical frame.

    Args:
        turn: rotation of the right camera, as a rotation vector (3,) in its own optical frame [rad].
    """
    baseline = np.array([calibration.baseline_m, 0.0, 0.0])
    # Row vectors times R apply the inverse rotation: into the rotated camera's frame.
    right = (x - baseline) @ Rotation.from_rotvec(turn).as_matrix()
    one, other = x[:, :2] / x[:, 2:], right[:, :2] / right[:, 2:]
    depth = calibration.baseline_m / (one[:, 0] - other[:, 0])
    return np.stack([one[:, 0] * depth, 0.5 * (one[:, 1] + other[:, 1]) * depth, depth], axis=1)


def correct(x: FloatArray, calibration: StereoCalibration, turn: FloatArray) -> FloatArray:
    """Return the true points (n, 3) [m] that `reported` maps to x (n, 3) [m]."""
    points = x
    for _ in range(_Settings.rounds):
        points = points + (x - reported(points, calibration, turn))
    return points


def by_turn(x: FloatArray, calibration: StereoCalibration, axes: FloatArray) -> FloatArray:
    """Return derivatives (n, 3, a) [m/rad] of `reported` at points (n, 3), for rotations about axes (a, 3)."""
    step = _Settings.step_rad
    ends = [(reported(x, calibration, step * axis), reported(x, calibration, -step * axis)) for axis in axes]
    return np.stack([(above - below) / (2.0 * step) for above, below in ends], axis=2)
