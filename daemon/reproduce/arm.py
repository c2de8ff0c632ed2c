"""The simulated arm of the experiments, and the poses it is learnt in."""

from __future__ import annotations

import numpy as np

from daemon.config import DaemonConfig
from daemon.gate import Accepted, Gate
from daemon.wiring import demonstration_model
from interfaces.records import FloatArray
from interfaces.robot import RobotDescription
from interfaces.toml_file import read_toml
from kbmaps import RigidChain

# Head and arm joints by their number, in the order from camera to marker; each has at least two of the head.
JOINTS = {
    5: ("neck_yaw", "neck_pitch", "shoulder_flexion", "shoulder_abduction", "elbow_flexion"),
    6: ("neck_yaw", "neck_pitch", "shoulder_flexion", "shoulder_abduction", "upperarm_rotation", "elbow_flexion"),
    7: (
        "neck_yaw",
        "neck_pitch",
        "shoulder_flexion",
        "shoulder_abduction",
        "upperarm_rotation",
        "elbow_flexion",
        "forearm_rotation",
    ),
}
# The paper's random walk: normally distributed about zero with this standard deviation [rad].
WALK_SIGMA = np.radians(22.0)
WALK_STEP_DEG = (1.0, 3.0)
FRAME_S = 1 / 30
FRAME_STEP = np.radians(1.0)


def arm(joints: int) -> RigidChain:
    """The shipped upper body with so many joints, from the left camera to the ball."""
    file = demonstration_model()
    tables, text = read_toml(file)
    tables["robot"] = {**tables["robot"], "joints": list(JOINTS[joints]), "held_at": {}}
    return RobotDescription.from_tables(tables, text, file).chain


def longer_tool(chain: RigidChain, by_m: float) -> RigidChain:
    """The chain with its marker farther from the hand."""
    marker = chain.fixed[-1][:3, 3]
    return chain.with_tool(by_m * marker / np.linalg.norm(marker))


def uniform(rng: np.random.Generator, count: int, joints: int, range_deg: float) -> FloatArray:
    """Poses (count, joints) [rad], each joint uniform within ± the range."""
    return np.radians(rng.uniform(-range_deg, range_deg, (count, joints)))


def walk(rng: np.random.Generator, count: int, chain: RigidChain) -> FloatArray:
    """A random walk (count, d) [rad] whose poses are normally distributed, in steps of 1 to 3 degrees.

    Metropolis steps; the sampler's own gate decides which poses become pairs.
    """
    gate = Gate(DaemonConfig(min_step_deg=WALK_STEP_DEG[0], max_step_deg=WALK_STEP_DEG[1]), chain.prismatic)
    pose, accepted, t = np.zeros(chain.joints), [], 0.0
    while len(accepted) < count:
        proposed = pose + FRAME_STEP / np.sqrt(chain.joints) * rng.normal(size=chain.joints)
        if rng.random() < np.exp((pose @ pose - proposed @ proposed) / (2.0 * WALK_SIGMA**2)):
            pose = proposed
        t += FRAME_S
        if isinstance(gate.offer(t, pose, chain.positions(pose)), Accepted):
            accepted.append(pose)
    return np.array(accepted)


def beside(rng: np.random.Generator, q: FloatArray, count: int, sigma_deg: float = 5.0) -> FloatArray:
    """Poses (count, d) near those of a walk, none of them in it."""
    chosen = q[rng.integers(len(q), size=count)]
    return chosen + np.radians(sigma_deg) * rng.normal(size=chosen.shape)
