"""The simulated arm of the experiments, and the poses at which it is learnt."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.daemon.config import Config, DaemonConfig, Tables
from bodyschema.daemon.wiring.wiring import demonstration_model
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.toml_file import read_toml
from kbmaps import ChainTolerances, RigidChain

# Head and arm joints by their number, ordered from camera to marker; each set has at least two head joints.
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
# Another set of six: one of the head and five of the arm.
OTHER_SIX = (
    "neck_pitch",
    "shoulder_flexion",
    "shoulder_abduction",
    "upperarm_rotation",
    "elbow_flexion",
    "forearm_rotation",
)
# Errors of a crude estimate: 1-sigma of each component of a joint's rotation [rad], of a link [m] and the marker [m].
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
    """Return the shipped upper body's robot.toml with other joints, store folder and rules."""
    file = demonstration_model()
    tables, text = read_toml(file)
    tables["robot"] = {**tables["robot"], "joints": list(joints), "held_at": {}}
    tables["sim"] = {**tables.get("sim", {}), "seed": sim_seed}
    robot = RobotDescription.from_tables(tables, text, file)
    parsed = msgspec.structs.replace(msgspec.convert(tables, Tables), daemon=rules)
    return Config(file, robot, parsed).with_state_dir(state_dir)


def arm(joints: int | Sequence[str]) -> RigidChain:
    """Return the shipped upper body's chain, left camera to ball, with these joints or this number of them."""
    names = JOINTS[joints] if isinstance(joints, int) else joints
    return configuration(names, Path(), DaemonConfig()).robot.chain


def longer_tool(chain: RigidChain, by_m: float) -> RigidChain:
    """Return the chain with its marker `by_m` farther from the hand [m]."""
    marker = chain.fixed[-1][:3, 3]
    return chain.with_tool(by_m * marker / np.linalg.norm(marker))


def crude_estimate(rng: np.random.Generator, chain: RigidChain) -> RigidChain:
    """Return a crude estimate of the chain, with errors sampled from `CRUDE`."""
    fixed = chain.fixed.copy()
    for transform in fixed:
        turn = Rotation.from_rotvec(CRUDE_TURN * rng.normal(size=3))
        transform[:3, :3] = transform[:3, :3] @ turn.as_matrix()
        transform[:3, 3] += CRUDE_LINK_M * rng.normal(size=3)
    return RigidChain(fixed, chain.axes, chain.prismatic).with_tool(CRUDE_MARKER_M * rng.normal(size=3))


def uniform(rng: np.random.Generator, count: int, joints: int, range_deg: float) -> FloatArray:
    """Return poses (count, joints) [rad], each joint uniform within ± the range."""
    return np.radians(rng.uniform(-range_deg, range_deg, (count, joints)))


def beside(rng: np.random.Generator, q: FloatArray, count: int, sigma_deg: float = 5.0) -> FloatArray:
    """Return poses (count, d) near those of a walk, but not part of it."""
    chosen = q[rng.integers(len(q), size=count)]
    return chosen + np.radians(sigma_deg) * rng.normal(size=chosen.shape)
