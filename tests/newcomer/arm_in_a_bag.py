"""A desk arm in a ROS 2 bag: joint states at 100 Hz, a ball seen by a camera at 30 Hz."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from written_bags import joint_topic, point_stamped, pose_stamped, write_bag

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from kbmaps import ChainParameters, ChainTolerances

NOISE_M = 5e-4
OFFSETS_DEG = (0.0, 2.0, -1.5, 0.0)


class ArmInABag:
    """An arm whose links are built to 0.1° and 0.5 mm, with joint offsets; its camera stands on the desk."""

    def __init__(self, robot: RobotDescription, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self._robot, self._parameters = robot, ChainParameters(robot.chain)
        made = ChainTolerances(0.002, 0.0005, tool=0.03)
        self._built = self._parameters.standard_deviations(made) * self.rng.normal(size=self._parameters.size)
        self._built[self._parameters.zeros] = np.radians(OFFSETS_DEG)

    def write(self, folder: Path, *, seconds: float, mcap: bool) -> Path:
        """Write a bag of a path of its own."""
        phases = self.rng.uniform(0, 2 * np.pi, (2, len(self._robot.joints)))
        t = np.arange(0.1, seconds - 0.1, 1 / 30) + 0.003
        x = self._parameters.positions(self._built, self._path(t, phases)) + NOISE_M * self.rng.normal(size=(len(t), 3))
        names = (*self._robot.joints, "finger")
        states = joint_topic(
            names, lambda at: np.column_stack([self._path(at, phases), 0.0 * at]), rate_hz=100.0, seconds=seconds
        )
        ball = [
            (at, point_stamped(at, each, "left_camera_optical_frame")) for at, each in zip(t.tolist(), x, strict=True)
        ]
        goals = [(at, pose_stamped(at, np.ones(3), "base_link")) for at in (1.0, 2.0)]
        topics = {"/joint_states": states, "/ball": ("PointStamped", ball), "/goal_pose": ("PoseStamped", goals)}
        return write_bag(folder, topics, mcap=mcap)

    def _path(self, t: FloatArray, phases: FloatArray) -> FloatArray:
        speeds = np.array([0.31, 0.47, 0.61, 0.83])
        slow, fast = np.sin(np.outer(t, 0.3 * speeds) + phases[0]), np.sin(np.outer(t, speeds) + phases[1])
        return 0.4 * self._robot.upper * (slow + fast)
