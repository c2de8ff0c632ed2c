"""Fit what robot.toml marks as unknown before anything else; it is never a finding."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.effects import Effect, Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

from .fit import Fit, fitted
from .observations import Observations

_ROUNDS, _KEPT = 10, 0.8


def aligned(observations: Observations, simulation: Simulation) -> Fit:
    """Fit the free camera pose and the free marker where robot.toml does not know them."""
    robot = simulation.robot
    nuisances = free_effects(robot)
    if not robot.camera.pose_known:
        predicted = simulation.positions(observations.motion)
        # The camera's pose comes first.
        nuisances = [nuisances[0].with_values(placed(predicted, observations.x)), *nuisances[1:]]
    own = list(simulation.effects)
    return fitted(observations, simulation.with_effects([*nuisances, *own]), len(nuisances) + len(own))


def free_effects(robot: RobotDescription) -> list[Effect]:
    """Return the effects that stand for what robot.toml does not know."""
    names = [] if robot.camera.pose_known else ["camera_pose"]
    names += [] if robot.robot.marker_known else ["tool_offset"]
    return [Effect.at(robot, name) for name in names]


def placed(predicted: FloatArray, x: FloatArray) -> FloatArray:
    """Return the camera pose (6,) from which predicted points (n, 3) match most of the measured points x (n, 3)."""
    kept = np.ones(len(x), dtype=bool)
    turn, shift = np.eye(3), np.zeros(3)
    for _ in range(_ROUNDS):
        centre, seen = predicted[kept].mean(axis=0), x[kept].mean(axis=0)
        turn = Rotation.align_vectors(predicted[kept] - centre, x[kept] - seen)[0].as_matrix()
        shift = centre - turn @ seen
        distance = np.linalg.norm((predicted - shift) @ turn - x, axis=1)
        kept = distance <= np.quantile(distance, _KEPT)
    return np.concatenate([shift, Rotation.from_matrix(turn).as_rotvec()])
