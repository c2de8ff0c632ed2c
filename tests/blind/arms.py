"""Arms of our own, written as URDF: kinematics, masses with centres off the axes, and where the cameras stand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from .arrays import FloatArray, Vector, vector

FLOOR, BASE, MOUNT = "floor", "base", "mount"
STOP_BEYOND_RANGE = 0.3  # rad or m: readings with an error still lie within the limits


@dataclass(frozen=True)
class Joint:
    """A joint of a URDF.

    Attributes:
        kind: revolute, prismatic or fixed.
        xyz, rpy: pose of the joint's frame in its parent link [m], [rad].
        lower, upper: the range that the arm is guided through [rad or m].
    """

    name: str
    kind: str
    parent: str
    child: str
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    lower: float = 0.0
    upper: float = 0.0

    @property
    def moves(self) -> bool:
        """True if the joint is not fixed."""
        return self.kind != "fixed"


@dataclass(frozen=True)
class Mass:
    """Mass [kg] of a link, and its centre in the link's frame [m]."""

    kg: float
    centre: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Eyes:
    """The rectified stereo pair as it is described: focal length, principal point, baseline, image, noise."""

    focal_px: float
    baseline_m: float
    pixel_sigma: float
    image_size_px: tuple[int, int] = (1280, 960)
    principal_point_px: tuple[float, float] = (640.0, 480.0)


@dataclass(frozen=True)
class Arm:
    """A whole robot: URDF, the joints that are read, cameras and marker.

    Attributes:
        joints: every joint of the URDF, parents before children.
        masses: by link.
        read: names of the joints that are read, in their order from camera to marker.
        ticks: encoder ticks per turn (per metre at a prismatic joint), by joint.
        camera_link, camera_xyz, camera_rpy: pose of the left optical frame in that link.
    """

    name: str
    joints: tuple[Joint, ...]
    masses: dict[str, Mass]
    read: tuple[str, ...]
    ticks: dict[str, int]
    camera_link: str
    camera_xyz: Vector
    camera_rpy: Vector
    eyes: Eyes
    marker_link: str
    marker_xyz: Vector

    def joint(self, name: str) -> Joint:
        """Return the joint called `name`."""
        return next(joint for joint in self.joints if joint.name == name)

    def mass(self, link: str) -> Mass:
        """Return the mass of a link; negligible if none is given."""
        return self.masses.get(link, Mass(1e-3))

    @property
    def ranges(self) -> FloatArray:
        """Lower and upper end of the range of each joint that is read [rad or m], shape (d, 2)."""
        return np.array([(self.joint(name).lower, self.joint(name).upper) for name in self.read])

    def quantum(self, name: str) -> float:
        """Return one encoder tick [rad or m]."""
        whole = 1.0 if self.joint(name).kind == "prismatic" else 2.0 * math.pi
        return whole / self.ticks[name]

    def with_joint(self, joint: Joint) -> Arm:
        """Return the same arm with the joint of that name replaced."""
        return replace(self, joints=tuple(joint if old.name == joint.name else old for old in self.joints))


def look_at(eye: FloatArray, target: FloatArray, roll_rad: float = 0.0) -> Vector:
    """Return rpy [rad] of an optical frame (x right, y down, z forward) at `eye` that looks at `target`."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    R = np.column_stack([right, np.cross(forward, right), forward]) @ Rotation.from_euler("z", roll_rad).as_matrix()
    return vector(Rotation.from_matrix(R).as_euler("xyz"))


def _chain(start: str, *rows: tuple[str, str, Vector, Vector, str, float, float]) -> tuple[Joint, ...]:
    """Return serial joints from name, kind, xyz, rpy, letter of the axis, range in degrees (m if prismatic)."""
    joints, parent = [], start
    for name, kind, xyz, rpy, axis, lower, upper in rows:
        unit = 1.0 if kind == "prismatic" else math.pi / 180.0
        along = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}[axis]
        joints.append(Joint(name, kind, parent, f"{name}_link", xyz, rpy, along, lower * unit, upper * unit))
        parent = f"{name}_link"
    return tuple(joints)


def _masses(joints: tuple[Joint, ...], kilograms: list[float], rng: np.random.Generator) -> dict[str, Mass]:
    """Return masses with centres about half way to the next joint and some centimetres off the axes."""
    ends = {joint.parent: np.array(joint.xyz) for joint in joints}
    masses = {}
    for joint, kg in zip(joints, kilograms, strict=True):
        centre = 0.5 * ends.get(joint.child, np.array([0.0, 0.0, 0.06])) + rng.uniform(-0.03, 0.03, 3)
        masses[joint.child] = Mass(float(kg * rng.uniform(0.9, 1.1)), vector(centre))
    return masses


def _standing_camera(rng: np.random.Generator, eye: Vector, target: Vector) -> tuple[Vector, Vector, Eyes]:
    """Draw a camera beside the arm: return its position, its orientation and its optics."""
    at = np.array(eye) + rng.uniform(-0.15, 0.15, 3)
    rpy = look_at(at, np.array(target) + rng.uniform(-0.08, 0.08, 3), rng.uniform(-0.1, 0.1))
    eyes = Eyes(
        focal_px=round(rng.uniform(680.0, 900.0), 1),
        baseline_m=round(rng.uniform(0.25, 0.5), 3),
        pixel_sigma=round(float(np.exp(rng.uniform(*np.log([0.1, 0.5])))), 2),
        principal_point_px=(round(rng.uniform(625, 655), 1), round(rng.uniform(470, 490), 1)),
    )
    return vector(at), rpy, eyes


def _beside(
    rng: np.random.Generator,
    name: str,
    chain: tuple[Joint, ...],
    kilograms: list[float],
    eye: Vector,
    target: Vector,
    mount: Joint | None = None,
) -> Arm:
    """Return an arm on its mount with a stereo camera standing beside it."""
    xyz, rpy, eyes = _standing_camera(rng, eye, target)
    read = tuple(joint.name for joint in chain)
    return Arm(
        name=name,
        joints=(mount or Joint(MOUNT, "fixed", FLOOR, BASE), *chain),
        masses={BASE: Mass(10.0, (0.02, -0.01, 0.05)), **_masses(chain, kilograms, rng)},
        read=read,
        ticks=_ticks(read, rng),
        camera_link=FLOOR,
        camera_xyz=xyz,
        camera_rpy=rpy,
        eyes=eyes,
        marker_link=chain[-1].child,
        marker_xyz=vector(np.array([0.03, 0.02, 0.09]) + rng.uniform(-0.02, 0.02, 3)),
    )


def _ticks(read: tuple[str, ...], rng: np.random.Generator) -> dict[str, int]:
    return {name: int(rng.choice([4096, 8192, 16384, 65536], p=[0.1, 0.2, 0.3, 0.4])) for name in read}


def industrial(rng: np.random.Generator) -> Arm:
    """Return an arm of six joints, shoulder and elbow offset to the side, a wrist with its axes 0.1 m apart."""
    chain = _chain(
        BASE,
        ("waist", "revolute", (0, 0, 0.32), (0, 0, 0), "z", -120, 120),
        ("shoulder", "revolute", (0.12, -0.06, 0.11), (0, 0, 0), "y", -50, 80),
        ("elbow", "revolute", (0, 0.03, 0.45), (0, 0, 0), "y", -110, 60),
        ("forearm_roll", "revolute", (0.16, 0.02, 0.05), (0, 0, 0), "x", -150, 150),
        ("wrist_bend", "revolute", (0.26, 0, 0), (0, 0, 0), "y", -100, 100),
        ("flange_roll", "revolute", (0.10, 0.02, 0), (0, 0, 0), "x", -170, 170),
    )
    return _beside(rng, "industrial", chain, [18.0, 12.0, 7.0, 5.0, 2.0, 0.8], (2.0, 0.9, 1.2), (0.2, 0.0, 0.55))


def humanoid(rng: np.random.Generator) -> Arm:
    """Return a humanoid's left arm of seven joints, its shoulder mounted sideways on a torso."""
    chain = _chain(
        BASE,
        ("shoulder_pitch", "revolute", (0, 0.17, 0.02), (0.2, 0, 0), "y", -130, 60),
        ("shoulder_roll", "revolute", (0, 0.05, 0), (0, 0, 0), "x", -20, 110),
        ("shoulder_yaw", "revolute", (0.01, 0, -0.12), (0, 0, 0), "z", -80, 80),
        ("elbow", "revolute", (-0.01, 0.01, -0.16), (0, 0, 0), "y", -120, 5),
        ("forearm_yaw", "revolute", (0.01, 0, -0.10), (0, 0, 0), "z", -80, 80),
        ("wrist_roll", "revolute", (0, 0.01, -0.14), (0, 0, 0), "x", -40, 40),
        ("wrist_pitch", "revolute", (0, 0, -0.02), (0, 0, 0), "y", -60, 60),
    )
    mount = Joint(MOUNT, "fixed", FLOOR, BASE, (0.0, 0.0, 1.1), (0.0, 0.05, 0.0))
    return _beside(
        rng, "humanoid", chain, [1.6, 1.2, 1.4, 0.9, 0.8, 0.4, 0.5], (1.5, 0.8, 1.4), (0.1, 0.25, 1.0), mount
    )


def gantry(rng: np.random.Generator) -> Arm:
    """Return a gantry of six joints, the second a lift: waist, lift, reach, elbow and a wrist of two."""
    chain = _chain(
        BASE,
        ("waist", "revolute", (0, 0, 0.20), (0, 0, 0), "z", -110, 110),
        ("lift", "prismatic", (0.08, 0.02, 0.15), (0.05, 0, 0), "z", 0.0, 0.45),
        ("upper", "revolute", (0.10, 0, 0.04), (0, 0, 0), "y", -50, 70),
        ("elbow", "revolute", (0.30, -0.02, 0.03), (0, 0, 0), "z", -120, 120),
        ("wrist_bend", "revolute", (0.24, 0.01, 0), (0, 0, 0), "y", -90, 90),
        ("wrist_roll", "revolute", (0.09, 0, 0.02), (0, 0, 0), "x", -160, 160),
    )
    return _beside(rng, "gantry", chain, [9.0, 6.0, 4.0, 3.0, 1.5, 0.6], (1.9, 0.7, 1.3), (0.2, 0.0, 0.6))


def head(rng: np.random.Generator) -> Arm:
    """Return two head joints that carry the cameras, and an arm of five: the chain leads down the neck to the arm."""
    neck = _chain(
        BASE,
        ("head_pan", "revolute", (0.02, 0, 0.22), (0, 0, 0), "z", -20, 60),
        ("head_tilt", "revolute", (0.01, 0.01, 0.09), (0, 0, 0), "y", 0, 60),
    )
    arm = _chain(
        BASE,
        ("shoulder_pitch", "revolute", (0, 0.16, 0.05), (0, 0, 0), "y", -110, 0),
        ("shoulder_roll", "revolute", (0.01, 0.05, 0), (0, 0, 0), "x", -30, 60),
        ("shoulder_yaw", "revolute", (0, 0.01, -0.13), (0, 0, 0), "z", -80, 60),
        ("elbow", "revolute", (0.01, 0, -0.15), (0, 0, 0), "y", -120, -10),
        ("wrist_yaw", "revolute", (0, 0, -0.21), (0, 0, 0), "z", -80, 80),
    )
    read = ("head_tilt", "head_pan", *(joint.name for joint in arm))
    straight = look_at(np.zeros(3), np.array([1.0, 0.0, 0.0]))
    return Arm(
        name="head",
        joints=(Joint(MOUNT, "fixed", FLOOR, BASE, (0.0, 0.0, 1.0)), *neck, *arm),
        masses={BASE: Mass(20.0, (0.0, 0.01, 0.1)), **_masses(neck + arm, [0.6, 2.2, 1.5, 1.2, 1.1, 0.9, 0.8], rng)},
        read=read,
        ticks=_ticks(read, rng),
        camera_link="head_tilt_link",
        camera_xyz=vector(np.array([0.06, 0.04, 0.05]) + rng.uniform(-0.01, 0.01, 3)),
        camera_rpy=vector(np.array(straight) + rng.uniform(-0.05, 0.05, 3)),
        eyes=Eyes(
            round(rng.uniform(520.0, 640.0), 1), round(rng.uniform(0.07, 0.12), 3), round(rng.uniform(0.1, 0.4), 2)
        ),
        marker_link=arm[-1].child,
        marker_xyz=vector(np.array([0.06, 0.02, -0.05]) + rng.uniform(-0.01, 0.01, 3)),
    )


def drawn(rng: np.random.Generator) -> Arm:
    """Return six joints with random lengths, twists and masses; neighbouring axes are never parallel along the link."""
    rows, letters = [("j1", "revolute", (0.0, 0.0, 0.25), (0.0, 0.0, 0.0), "z", -110.0, 110.0)], "yyxyx"
    for index, letter in enumerate(letters, 2):
        length = rng.uniform(0.18, 0.34) * (0.5 if index > 4 else 1.0)
        xyz = vector(np.array([length, 0.0, 0.0]) + rng.uniform(-0.05, 0.05, 3))
        rows.append((f"j{index}", "revolute", xyz, vector(rng.uniform(-0.3, 0.3, 3)), letter, -80.0, 80.0))
    kilograms = list(rng.uniform(0.7, 1.3, 6) * np.array([8.0, 6.0, 4.0, 2.5, 1.5, 0.7]))
    return _beside(rng, "drawn", _chain(BASE, *rows), kilograms, (2.0, 0.8, 1.2), (0.2, 0.0, 0.4))


ARMS: dict[str, Callable[[np.random.Generator], Arm]] = {
    "industrial": industrial,
    "humanoid": humanoid,
    "head": head,
    "gantry": gantry,
    "drawn": drawn,
}


def urdf(arm: Arm) -> str:
    """Return the arm as a URDF, every number with all its digits."""
    links = [FLOOR, *(joint.child for joint in arm.joints)]
    lines = [f'<robot name="{arm.name}">', *(_link(name, arm.mass(name)) for name in links)]
    return "\n".join([*lines, *map(_joint, arm.joints), "</robot>", ""])


def _row(values: Vector) -> str:
    return " ".join(repr(float(value)) for value in values)


def _link(name: str, mass: Mass) -> str:
    about = mass.kg * 0.005
    return (
        f'  <link name="{name}"><inertial><origin xyz="{_row(mass.centre)}"/><mass value="{mass.kg!r}"/>'
        f'<inertia ixx="{about}" ixy="0" ixz="0" iyy="{about}" iyz="0" izz="{about}"/></inertial></link>'
    )


def _joint(joint: Joint) -> str:
    lower, upper = joint.lower - STOP_BEYOND_RANGE, joint.upper + STOP_BEYOND_RANGE
    limit = f'<axis xyz="{_row(joint.axis)}"/><limit lower="{lower}" upper="{upper}" effort="99" velocity="9"/>'
    return (
        f'  <joint name="{joint.name}" type="{joint.kind}"><parent link="{joint.parent}"/><child link="{joint.child}"/>'
        f'<origin xyz="{_row(joint.xyz)}" rpy="{_row(joint.rpy)}"/>{limit if joint.moves else ""}</joint>'
    )
