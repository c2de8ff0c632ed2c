"""Recordings of the desk arm with effects in it, walked over its joints' range."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

DESK_ARM = Path(__file__).parents[2] / "examples" / "desk_arm" / "robot.toml"
PAIRS, SIGMA_M = 300, 3e-4


def walked(robot: RobotDescription, *effects: Effect, seed: int = 3, timed: bool = True) -> Recording:
    """Return a walk of an arm that has `effects`, at 4 pairs per second."""
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(size=(PAIRS, len(robot.joints))), axis=0)
    walk = (walk - walk.min(axis=0)) / np.ptp(walk, axis=0)
    q = robot.lower + (0.1 + 0.8 * walk) * (robot.upper - robot.lower)
    t = np.arange(PAIRS) / 4.0 if timed else None
    motion = Motion(q, t, np.zeros(PAIRS, np.int64))
    x = Simulation(robot, effects).positions(motion) + SIGMA_M * rng.normal(size=(PAIRS, 3))
    return Recording(joints=robot.joints, q=q, x=x, t=t)
