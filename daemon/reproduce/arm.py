"""The simulated arm of the experiments, and the poses it is learnt in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.daemon.config import Config, DaemonConfig, Tables
from bodyschema.daemon.wiring import demonstration_model
from bodyschema.effects import Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.robot import RobotDescription
from bodyschema.interfaces.toml_file import read_toml
from kbmaps import ChainTolerances, RigidChain

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
# Another six: one of the head and five of the arm.
OTHER_SIX = (
    "neck_pitch",
    "shoulder_flexion",
    "shoulder_abduction",
    "upperarm_rotation",
    "elbow_flexion",
    "forearm_rotation",
)
# A crude estimate: 1-sigma of each component of a joint's rotation [rad], of a link [m], and of the marker [m].
CRUDE_TURN, CRUDE_LINK_M, CRUDE_MARKER_M = np.radians(3.0), 0.015, 0.060
CRUDE = ChainTolerances(
    axes=CRUDE_TURN,
    points=CRUDE_LINK_M,
    zeros=CRUDE_TURN,
    tool=CRUDE_MARKER_M,
    base_rotation=CRUDE_TURN,
    base_translation=CRUDE_LINK_M,
)


def configuration(joints: Sequence[str], state_dir: Path, rules: DaemonConfig, *, sim_seed: int = 0) -> Config:
    """robot.toml of the shipped upper body, with other joints, another folder for the store and other rules."""
    file = demonstration_model()
    tables, text = read_toml(file)
    tables["robot"] = {**tables["robot"], "joints": list(joints), "held_at": {}}
    tables["sim"] = {**tables.get("sim", {}), "seed": sim_seed}
    robot = RobotDescription.from_tables(tables, text, file)
    parsed = msgspec.structs.replace(msgspec.convert(tables, Tables), daemon=rules)
    return Config(file, robot, parsed, Simulation(robot)).with_state_dir(state_dir)


def arm(joints: int | Sequence[str]) -> RigidChain:
    """The shipped upper body with so many joints, or these, from the left camera to the ball."""
    names = JOINTS[joints] if isinstance(joints, int) else joints
    return configuration(names, Path(), DaemonConfig()).robot.chain


def longer_tool(chain: RigidChain, by_m: float) -> RigidChain:
    """The chain with its marker farther from the hand."""
    marker = chain.fixed[-1][:3, 3]
    return chain.with_tool(by_m * marker / np.linalg.norm(marker))


def crude_estimate(rng: np.random.Generator, chain: RigidChain) -> RigidChain:
    """The chain as a crude estimate has it: its errors are drawn from `CRUDE`."""
    fixed = chain.fixed.copy()
    for transform in fixed:
        turn = Rotation.from_rotvec(CRUDE_TURN * rng.normal(size=3))
        transform[:3, :3] = transform[:3, :3] @ turn.as_matrix()
        transform[:3, 3] += CRUDE_LINK_M * rng.normal(size=3)
    return RigidChain(fixed, chain.axes, chain.prismatic).with_tool(CRUDE_MARKER_M * rng.normal(size=3))


def uniform(rng: np.random.Generator, count: int, joints: int, range_deg: float) -> FloatArray:
    """Poses (count, joints) [rad], each joint uniform within ± the range."""
    return np.radians(rng.uniform(-range_deg, range_deg, (count, joints)))


def beside(rng: np.random.Generator, q: FloatArray, count: int, sigma_deg: float = 5.0) -> FloatArray:
    """Poses (count, d) near those of a walk, none of them in it."""
    chosen = q[rng.integers(len(q), size=count)]
    return chosen + np.radians(sigma_deg) * rng.normal(size=chosen.shape)
