"""An arm with all that effects act on: a head that carries the camera, a prismatic joint, masses, a held joint."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyschema.effects import EFFECT_TYPES, Effect, Motion
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

LINKS = {
    "base": (20.0, "0 0 0.2"),
    "neck": (0.7, "0.01 0 0.03"),
    "head": (3.1, "0.04 0.01 0.05"),
    "shoulder": (3.3, "0.02 0 0.05"),
    "upper": (2.4, "0.14 0.01 0"),
    "fore": (1.6, "0.1 -0.01 0.02"),
    "rail": (0.9, "0.05 0 0.01"),
    "wrist": (0.6, "0.02 0.01 0"),
    "hand": (0.4, "0.03 0 0.02"),
}
# name, kind, parent, child, xyz, rpy, axis
JOINTS = (
    ("neck_yaw", "revolute", "base", "neck", "0 0 0.55", "0 0 0.1", "0 0 1"),
    ("neck_tilt", "revolute", "neck", "head", "0.02 0 0.06", "0.05 0 0", "0 1 0"),
    ("shoulder_yaw", "revolute", "base", "shoulder", "0.1 -0.15 0.35", "0.1 0 0", "0 0 1"),
    ("shoulder_lift", "revolute", "shoulder", "upper", "0 0 0.08", "0 0.2 0", "0 1 0"),
    ("elbow", "revolute", "upper", "fore", "0.28 0.02 0", "0 -0.3 0.1", "0 1 0.1"),
    ("rail", "prismatic", "fore", "rail", "0.2 0 0", "0 0 0.2", "1 0 0.2"),
    ("twist", "revolute", "rail", "wrist", "0.06 0 0.01", "0.3 0 0", "1 0 0"),
    ("wrist", "revolute", "wrist", "hand", "0.05 0 0", "0 0 0.4", "0 0.3 1"),
)
ALL = ("neck_tilt", "neck_yaw", "shoulder_yaw", "shoulder_lift", "elbow", "rail", "wrist")
UPWARD, SLIDE = ALL[:2], "rail"
INERTIA = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>'
TOML = """[robot]
name = "everything"
urdf = "everything.urdf"
joints = [{joints}]
marker_link = "hand"
marker_xyz = [0.06, 0.02, 0.03]
hold = "{hold}"
[robot.held_at]
twist = 0.3
[camera]
parent_link = "head"
xyz = [0.08, 0.03, 0.04]
rpy = [-1.77, 0.0, -1.87]
"""
STEREO = """focal_px = 700.0
principal_point_px = [640.0, 480.0]
baseline_m = 0.12
image_size_px = [1280, 960]
"""


def arm(folder: Path, hold: str = "held", tables: str = STEREO) -> RobotDescription:
    """Write the arm to files of its own and load it."""
    links = "".join(
        f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>{INERTIA}</inertial></link>'
        for name, (mass, centre) in LINKS.items()
    )
    joints = "".join(
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
        '<limit lower="-2" upper="2" effort="100" velocity="5"/></joint>'
        for name, kind, parent, child, xyz, rpy, axis in JOINTS
    )
    (folder / "everything.urdf").write_text(f'<robot name="everything">{links}{joints}</robot>')
    names = ", ".join(f'"{name}"' for name in ALL)
    file = folder / "robot.toml"
    file.write_text(TOML.format(joints=names, hold=hold) + tables)
    return RobotDescription.load(file)


def walk(seed: int = 0, rows: int = 120) -> Motion:
    """Return a smooth motion in three runs; the camera sees the marker throughout."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0.0, 0.08 * rows, rows)) + 0.002 * np.arange(rows)
    d = len(ALL)
    size = np.array([0.1, 0.15, 0.4, 0.35, 0.5, 0.08, 0.5])
    phase, rate = rng.uniform(0, 2 * np.pi, (2, d)), rng.uniform(0.5, 1.6, (2, d))
    q = size * (0.7 * np.sin(t[:, None] * rate[0] + phase[0]) + 0.3 * np.sin(2 * t[:, None] * rate[1] + phase[1]))
    return Motion(q, t, np.repeat([0, 1, 2], [rows // 2, rows // 4, rows - rows // 2 - rows // 4]).astype(np.int64))


def everywhere(robot: RobotDescription) -> list[tuple[str, str | None, str | None]]:
    """Return every effect at every possible joint; a coupling from one other joint each."""
    found: list[tuple[str, str | None, str | None]] = []
    for kind in EFFECT_TYPES.values():
        for k, joint in enumerate(robot.joints if kind.at_joint else (None,)):
            if kind.turns_only and joint == SLIDE:
                continue
            found.append((kind.name, joint, robot.joints[k - 1] if kind.takes_source else None))
    return found


def sized(robot: RobotDescription, where: tuple[str, str | None, str | None], share: float, seed: int = 0) -> Effect:
    """Return an effect that begins in the middle of the walk, with this share of its usual amounts and random signs."""
    effect = Effect.at(robot, *where)
    rng = np.random.default_rng(seed)
    values: FloatArray = np.array(effect.values)
    for k, parameter in enumerate(effect.parameters):
        if parameter.is_amount:
            sign = rng.choice([-1.0, 1.0])
            values[k] = share * parameter.usual * (1.0 if parameter.never_negative else sign)
        elif parameter.name == "t0":
            values[k] = 4.0
        elif parameter.name == "time_constant_s":
            values[k] = 3.0
        elif parameter.name == "memory":
            values[k] = 0.4
        elif parameter.name.startswith("hold_"):
            values[k] = 0.1
    return effect.with_values(values)
