"""The gaze: the head turned so that the nominal model sees the marker in the middle of both images."""

from __future__ import annotations

import numpy as np

from interfaces.camera import StereoCalibration
from interfaces.records import FloatArray
from interfaces.robot import RobotDescription
from kbmaps import RigidChain

# Damping of the least-squares step, in squared tangents of angle: large enough to stay calm where the head points at
# the marker along one of its own axes.
_DAMPING = 1e-2
_SOLVE_STEPS = 12
_LONGEST_STEP = 0.4
_TRACK_GAIN = 0.25
_NEAREST_M = 0.05
_NUDGE = 1e-6


class Gaze:
    """Solves and tracks the angles of the gazing joints. All angles are reported ones.

    Args:
        robot: the description; its nominal model is all that the gaze knows.
        joints: indices of the gazing joints in q; may be empty.
        speed_rad_s: greatest speed of each joint [rad/s].
    """

    def __init__(
        self, robot: RobotDescription, calibration: StereoCalibration, joints: tuple[int, ...], speed_rad_s: float
    ) -> None:
        self._robot = robot
        self._joints = list(joints)
        self._speed = speed_rad_s
        self._lower, self._upper = robot.lower[self._joints], robot.upper[self._joints]
        self._half_baseline = np.array([calibration.baseline_m / 2, 0.0, 0.0])
        width, height = calibration.image_size_px
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        self._centre = (middle - np.array(calibration.principal_point_px)) / calibration.focal_px
        self._chain = robot.chain

    def hold_tool(self, marker_xyz: FloatArray) -> None:
        """From now on look at a marker at `marker_xyz` (3,) [m] in the marker link."""
        self._chain = nominal_chain(self._robot, marker_xyz)

    def solve(self, q: FloatArray) -> FloatArray:
        """q (n, d) with the gazing joints turned to the marker, each as far as its limits allow."""
        q = q.copy()
        if self._joints:
            for _ in range(_SOLVE_STEPS):
                q[:, self._joints] = self._clipped(q[:, self._joints] + self._step(q))
        return q

    def track(self, q: FloatArray, command: FloatArray, dt: float) -> FloatArray:
        """The next command (g,) to the gazing joints' servos, from the reading q (d,) and the last command."""
        if not self._joints:
            return command
        step = _TRACK_GAIN * self._step(q[None])[0]
        return self._clipped(command + np.clip(step, -self._speed * dt, self._speed * dt))

    def _step(self, q: FloatArray) -> FloatArray:
        """Damped least-squares steps (n, g) towards the centre."""
        off_centre = self._off_centre(q)
        # Derivative by differences: one batch of positions costs less than a Jacobian.
        nudged = q[:, None] + _NUDGE * np.eye(q.shape[1])[self._joints]
        changed = self._off_centre(nudged.reshape(-1, q.shape[1])).reshape(*nudged.shape[:2], 2)
        J = ((changed - off_centre[:, None]) / _NUDGE).swapaxes(1, 2)
        step = _damped_step(J, off_centre)
        # A joint at its limit that would have to go on is out of the game; the others do what is left.
        angles = q[:, self._joints]
        stuck = ((angles <= self._lower) & (step < 0)) | ((angles >= self._upper) & (step > 0))
        return np.clip(_damped_step(J * ~stuck[:, None], off_centre), -_LONGEST_STEP, _LONGEST_STEP)

    def _off_centre(self, q: FloatArray) -> FloatArray:
        """Tangents (n, 2) of the angles by which the marker, seen from between the eyes, misses the images' middle."""
        x = self._chain.positions(q) - self._half_baseline
        return x[:, :2] / np.maximum(x[:, 2:], _NEAREST_M) - self._centre

    def _clipped(self, angles: FloatArray) -> FloatArray:
        return np.clip(angles, self._lower, self._upper)


def _damped_step(J: FloatArray, error: FloatArray) -> FloatArray:
    """Levenberg-Marquardt steps (n, g) for Jacobians (n, 2, g) and errors (n, 2)."""
    damped = J @ J.swapaxes(1, 2) + _DAMPING * np.eye(2)
    return -(J.swapaxes(1, 2) @ np.linalg.solve(damped, error[..., None]))[..., 0]


def nominal_chain(robot: RobotDescription, marker_xyz: FloatArray) -> RigidChain:
    """The robot's described chain with its marker at `marker_xyz` (3,) [m] in the marker link."""
    return robot.chain.with_tool(marker_xyz - np.array(robot.robot.marker_xyz))
