"""Gaze control: turn the head so that, by the nominal model, the marker is in the middle of both images."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.pointing import Pointing
from kbmaps import RigidChain

_SOLVE_STEPS = 12
_TRACK_GAIN = 0.25


class Gaze:
    """Solver and tracker of the gazing joints' angles. All angles are reported angles.

    Args:
        robot: the description; the gaze uses only its nominal model.
        joints: indices of the gazing joints in q; may be empty.
        speed_rad_s: maximum speed of each joint [rad/s].
    """

    def __init__(
        self, robot: RobotDescription, calibration: StereoCalibration, joints: tuple[int, ...], speed_rad_s: float
    ) -> None:
        self._robot = robot
        self._joints = list(joints)
        self._speed = speed_rad_s
        self._pointing = Pointing(calibration, joints, robot.lower[self._joints], robot.upper[self._joints])
        self._chain = robot.chain

    def hold_tool(self, marker_xyz: FloatArray) -> None:
        """Look at a marker at `marker_xyz` (3,) [m] in the marker link from now on."""
        self._chain = nominal_chain(self._robot, marker_xyz)

    def solve(self, q: FloatArray) -> FloatArray:
        """Return q (n, d) with the gazing joints turned to the marker, each within its limits."""
        q = q.copy()
        if self._joints:
            for _ in range(_SOLVE_STEPS):
                step = self._pointing.step(q, self._chain.positions)
                q[:, self._joints] = self._pointing.clipped(q[:, self._joints] + step)
        return q

    def track(self, q: FloatArray, command: FloatArray, dt: float) -> FloatArray:
        """Return the next command (g,) to the gazing joints' servos, from the reading q (d,) and the last command."""
        if not self._joints:
            return command
        step = _TRACK_GAIN * self._pointing.step(q[None], self._chain.positions)[0]
        return self._pointing.clipped(command + np.clip(step, -self._speed * dt, self._speed * dt))


def nominal_chain(robot: RobotDescription, marker_xyz: FloatArray) -> RigidChain:
    """Return the robot's described chain with its marker at `marker_xyz` (3,) [m] in the marker link."""
    return robot.chain.with_tool(marker_xyz - np.array(robot.robot.marker_xyz))
