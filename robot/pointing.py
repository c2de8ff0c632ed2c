"""Turn joints so that the cameras see the marker in the middle of both images."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray, frozen_array


class _Settings:
    # Damping of the step [squared tangents of angle]; stabilises it where one of the head's axes points at the marker.
    damping: float = 1e-2
    longest_step: float = 0.4
    nearest_m: float = 0.05
    nudge: float = 1e-6


Positions = Callable[[FloatArray], FloatArray]
"""From joint angles [rad] (n, d) the marker's positions in the measurement frame [m] (n, 3)."""


class Pointing:
    """Steps of the gazing joints towards the marker, for any model of its position.

    Args:
        joints: indices of the gazing joints in q.
        lower, upper: limits of these joints [rad] (g,).
    """

    def __init__(
        self, calibration: StereoCalibration, joints: Sequence[int], lower: FloatArray, upper: FloatArray
    ) -> None:
        self._joints = list(joints)
        self._lower, self._upper = frozen_array(lower), frozen_array(upper)
        self._half_baseline = np.array([calibration.baseline_m / 2, 0.0, 0.0])
        width, height = calibration.image_size_px
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        self._centre = (middle - np.array(calibration.principal_point_px)) / calibration.focal_px

    def step(self, q: FloatArray, positions: Positions) -> FloatArray:
        """Return damped least-squares steps (n, g) of the gazing joints from q (n, d) towards the centre [rad]."""
        # Derivative by finite differences: one batch of positions costs less than a Jacobian.
        nudged = q[:, None] + _Settings.nudge * np.eye(q.shape[1])[self._joints]
        rows = np.concatenate([q, nudged.reshape(-1, q.shape[1])])
        # Tangents (n, 2) of the angles to the image centre, seen from the middle of the baseline.
        x = positions(rows) - self._half_baseline
        missed = x[:, :2] / np.maximum(x[:, 2:], _Settings.nearest_m) - self._centre
        off_centre = missed[: len(q)]
        changed = missed[len(q) :].reshape(*nudged.shape[:2], 2)
        J = ((changed - off_centre[:, None]) / _Settings.nudge).swapaxes(1, 2)
        step = _damped_step(J, off_centre)
        # A joint that is blocked by its limit is excluded; the others take over.
        angles = q[:, self._joints]
        stuck = ((angles <= self._lower) & (step < 0)) | ((angles >= self._upper) & (step > 0))
        return np.clip(_damped_step(J * ~stuck[:, None], off_centre), -_Settings.longest_step, _Settings.longest_step)

    def clipped(self, angles: FloatArray) -> FloatArray:
        """Return angles (…, g) within the limits."""
        return np.clip(angles, self._lower, self._upper)


def _damped_step(J: FloatArray, error: FloatArray) -> FloatArray:
    """Return Levenberg-Marquardt steps (n, g) for Jacobians (n, 2, g) and errors (n, 2)."""
    damped = J @ J.swapaxes(1, 2) + _Settings.damping * np.eye(2)
    return -(J.swapaxes(1, 2) @ np.linalg.solve(damped, error[..., None]))[..., 0]
