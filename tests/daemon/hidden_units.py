"""Recordings of units of one type of arm, each with a fault planted in its kinematics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

DESK_ARM = Path(__file__).parents[2] / "examples" / "desk_arm" / "robot.toml"
PAIRS, SIGMA_M = 240, 3e-4


def walk(robot: RobotDescription, rng: np.random.Generator) -> FloatArray:
    """Return joint angles (n, d) [rad] of a walk over most of the joints' ranges."""
    steps = np.cumsum(rng.normal(size=(PAIRS, len(robot.joints))), axis=0)
    shares = (steps - steps.min(axis=0)) / np.ptp(steps, axis=0)
    return robot.lower + (0.1 + 0.8 * shares) * (robot.upper - robot.lower)


def unit(robot: RobotDescription, seed: int, *, scaled: tuple[int, float] | None = None) -> Recording:
    """Return one unit's recording.

    Args:
        scaled: a joint's number, and by which factor it turns farther than its encoder says.
    """
    rng = np.random.default_rng(seed)
    read = walk(robot, rng)
    turned = read.copy()
    if scaled is not None:
        joint, factor = scaled
        turned[:, joint] *= factor
    x = robot.chain.positions(turned) + SIGMA_M * rng.normal(size=(PAIRS, 3))
    return Recording(joints=robot.joints, q=read, x=x, t=np.arange(PAIRS) / 4.0)
