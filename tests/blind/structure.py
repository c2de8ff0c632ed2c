"""The true arm: the described one with other links, with springs, with links that grow."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from .arms import BASE, MOUNT, Arm, Joint, Mass
from .arrays import FloatArray, Vector, vector
from .eyes import TrueEyes
from .hidden import Hidden, Parameters
from .kinds import SHIFT, SIX

NO_MASS = Mass(1e-6)
SHORTEST_BENDING_LINK_M = 0.08


@dataclass
class Structure:
    """The true structure of an arm.

    Attributes:
        arm: with every joint it truly has; those added are not among `arm.read`.
        compliance: of springs by joint [rad/(N·m) or m/N].
        growth: final length [m] and time constant [s] of joints that grow.
    """

    arm: Arm
    eyes: TrueEyes
    compliance: dict[str, float] = field(default_factory=dict)
    growth: dict[str, tuple[float, float]] = field(default_factory=dict)


def true_structure(arm: Arm, effects: Iterable[Hidden]) -> Structure:
    """Return the described arm and cameras as the effects change them."""
    true = Structure(arm, TrueEyes.as_described(arm.eyes))
    for number, hidden in enumerate(effects):
        _apply(true, hidden, f"hidden{number}")
    return true


def bending_joints(arm: Arm) -> tuple[str, ...]:
    """Return the joints whose links are long enough to bend and carry another joint."""
    return tuple(name for name in arm.read if _next_joint(arm, name) is not None)


def _apply(true: Structure, hidden: Hidden, prefix: str) -> None:
    p, arm = hidden.parameters, true.arm
    match hidden.effect:
        case "link_geometry":
            joint = arm.joint(str(hidden.where))
            xyz, rpy = _moved(joint.xyz, joint.rpy, p)
            true.arm = arm.with_joint(replace(joint, xyz=xyz, rpy=rpy))
        case "tool_offset":
            true.arm = replace(arm, marker_xyz=vector(np.array(arm.marker_xyz) + shift(p)))
        case "camera_pose":
            xyz, rpy = _moved(arm.camera_xyz, arm.camera_rpy, p)
            true.arm = replace(arm, camera_xyz=xyz, camera_rpy=rpy)
        case "camera_scale":
            true.eyes = replace(true.eyes, baseline_m=true.eyes.baseline_m * (1.0 + p["scale"]))
        case "camera_focal":
            true.eyes = replace(true.eyes, focal_px=true.eyes.focal_px * (1.0 + p["scale"]))
        case "lens_distortion":
            true.eyes = replace(true.eyes, k1=true.eyes.k1 + p["k1"], k2=true.eyes.k2 + p["k2"])
        case "vergence":
            true.eyes = replace(true.eyes, vergence_rad=true.eyes.vergence_rad + p["vergence_rad"])
        case "joint_compliance":
            where = str(hidden.where)
            softer = next(value for name, value in p.items() if name.startswith("compliance"))
            true.compliance[where] = true.compliance.get(where, 0.0) + softer
        case "soft_mount":
            _soften_mount(true, p, prefix)
        case "link_bend":
            _soften_link(true, str(hidden.where), p["bend_rad_per_Nm"], prefix)
        case "growing_link":
            _grow(true, str(hidden.where), p, prefix)
        case _:
            pass  # sits elsewhere than in the structure


def shift(p: Parameters) -> FloatArray:
    """Return dx, dy, dz [m]."""
    return np.array([p[name] for name in SHIFT])


def pose(p: Parameters) -> tuple[FloatArray, FloatArray]:
    """Return shift [m] and rotation (3, 3) of six parameters."""
    six = np.array([p[name] for name in SIX])
    return six[:3], Rotation.from_rotvec(six[3:]).as_matrix()


def _moved(xyz: Vector, rpy: Vector, p: Parameters) -> tuple[Vector, Vector]:
    """Return the pose of a frame after a motion in its own axes."""
    x, R = pose(p)
    was = Rotation.from_euler("xyz", rpy).as_matrix()
    return vector(np.array(xyz) + was @ x), vector(Rotation.from_matrix(was @ R).as_euler("xyz"))


def _insert(true: Structure, before: Joint, between: list[Joint]) -> None:
    """Insert joints between the parent of `before` and `before`, which continues from the last of them."""
    joints = list(true.arm.joints)
    index = [joint.name for joint in joints].index(before.name)
    joints[index : index + 1] = [*between, replace(before, parent=between[-1].child)]
    masses = {**true.arm.masses, **{joint.child: NO_MASS for joint in between}}
    true.arm = replace(true.arm, joints=tuple(joints), masses=masses)


def _soften_mount(true: Structure, p: Parameters, prefix: str) -> None:
    """Insert two hinges and a slide between the mount's place on the floor and the base."""
    mount = true.arm.joint(MOUNT)
    a, b, c = f"{prefix}_a", f"{prefix}_b", f"{prefix}_c"
    place = replace(mount, name=f"{prefix}_place", child=a)
    hinges = [
        Joint(f"{prefix}_x", "revolute", a, b, axis=(1.0, 0.0, 0.0)),
        Joint(f"{prefix}_y", "revolute", b, c, axis=(0.0, 1.0, 0.0)),
        Joint(f"{prefix}_z", "prismatic", c, f"{prefix}_d", axis=(0.0, 0.0, 1.0)),
    ]
    _insert(true, replace(mount, xyz=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0), child=BASE), [place, *hinges])
    for hinge in hinges:
        true.compliance[hinge.name] = p["sink_m_per_N" if hinge.kind == "prismatic" else "tilt_rad_per_Nm"]


def _soften_link(true: Structure, where: str, bend: float, prefix: str) -> None:
    """Insert two hinges across the link, half way to the next joint."""
    following = _next_joint(true.arm, where)
    if following is None:
        raise ValueError(f"the link of {where} is too short to bend")
    half = vector(0.5 * np.array(following.xyz))
    across = np.linalg.svd(np.array([following.xyz]))[2][1:]
    first = Joint(f"{prefix}_u", "revolute", following.parent, f"{prefix}_a", half, axis=vector(across[0]))
    second = Joint(f"{prefix}_v", "revolute", f"{prefix}_a", f"{prefix}_b", axis=vector(across[1]))
    _insert(true, replace(following, xyz=half), [first, second])
    true.compliance[first.name] = true.compliance[second.name] = bend


def _grow(true: Structure, where: str, p: Parameters, prefix: str) -> None:
    """Insert a prismatic joint between the joint and its parent."""
    joint, along = true.arm.joint(where), shift(p)
    length = float(np.linalg.norm(along))
    slide = Joint(f"{prefix}_s", "prismatic", joint.parent, f"{prefix}_a", axis=vector(along / length))
    _insert(true, joint, [slide])
    true.growth[slide.name] = (length, p["tau_s"])


def _next_joint(arm: Arm, name: str) -> Joint | None:
    """Return the joint carried by the link of `name`, if the link is long enough to bend."""
    link = arm.joint(name).child
    borne = [joint for joint in arm.joints if joint.parent == link]
    far = [joint for joint in borne if np.linalg.norm(joint.xyz) >= SHORTEST_BENDING_LINK_M]
    return far[0] if far else None
