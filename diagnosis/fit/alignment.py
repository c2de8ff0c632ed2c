"""Fit the parameters that robot.toml marks as unknown before anything else; they are never a finding."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.effects import EFFECT_TYPES, Effect, Simulation
from bodyschema.interfaces.records import FloatArray

from .fit import Fit, fitted
from .observations import Observations


class _Settings:
    rounds, kept_share = 10, 0.8


def aligned(observations: Observations, simulation: Simulation) -> Fit:
    """Fit the camera pose and the marker if robot.toml does not know them."""
    robot = simulation.robot
    free = [kind.name for kind in EFFECT_TYPES.values() if kind.is_free(robot)]
    # Start with the camera's pose, from which the rest is fitted.
    nuisances = [Effect.at(robot, name) for name in reversed(free)]
    if not robot.camera.pose_known:
        pose = placed(simulation.positions(observations.motion), observations.x)
        nuisances = [one.with_values(pose) if one.kind.stage == "camera" else one for one in nuisances]
    own = list(simulation.effects)
    return fitted(observations, simulation.with_effects([*nuisances, *own]), len(nuisances) + len(own))


def placed(predicted: FloatArray, x: FloatArray) -> FloatArray:
    """Return the camera pose (6,) from which predicted points (n, 3) match most of the measured points x (n, 3)."""
    kept = np.ones(len(x), dtype=bool)
    turn, shift = np.eye(3), np.zeros(3)
    for _ in range(_Settings.rounds):
        centre, seen = predicted[kept].mean(axis=0), x[kept].mean(axis=0)
        turn = Rotation.align_vectors(predicted[kept] - centre, x[kept] - seen)[0].as_matrix()
        shift = centre - turn @ seen
        distance = np.linalg.norm((predicted - shift) @ turn - x, axis=1)
        kept = distance <= np.quantile(distance, _Settings.kept_share)
    return np.concatenate([shift, Rotation.from_matrix(turn).as_rotvec()])
