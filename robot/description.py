"""robot.toml and its URDF: joints, camera and marker."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from bodyschema.interfaces.camera import LARGEST_SIDE_PX, StereoCalibration
from bodyschema.interfaces.errors import ConfigError, RobotError
from bodyschema.interfaces.records import FloatArray, frozen_array
from kbmaps import RigidChain

from .rpy import pose_of, rpy_of
from .toml_file import NAME, Positive, convert, line_of, read_toml
from .urdf import MOVING, UrdfJoint, UrdfTree, chain_between, joint_transforms

Vector3 = tuple[float, float, float]
Side = Annotated[int, Meta(ge=1, le=LARGEST_SIDE_PX)]
ImageSize = tuple[Side, Side]
# Beyond these a number is of another unit: degrees, millimetres.
LARGEST_TURN_RAD, LONGEST_TOOL_M, FARTHEST_CAMERA_M = 2.0 * math.pi, 2.0, 50.0
Name = Annotated[str, Meta(pattern=NAME)]


class RobotSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [robot]."""

    name: Name  # letters, digits, `_`, `.`, `-`; part of the zenoh keys
    urdf: str  # file, relative to robot.toml; meshes and masses are not needed
    # the joints to read and learn, from camera to marker; the order of `q` everywhere. At most twelve revolute joints,
    # more if some are prismatic.
    joints: Annotated[tuple[str, ...], Meta(min_length=1)]
    marker_link: str  # the link that carries the marker
    marker_xyz: Vector3 = (0.0, 0.0, 0.0)  # the marker in that link [m]
    marker_known: bool = True  # false: `marker_xyz` is a guess and is fitted first
    # what bears the arm while recording: `torque_free` (your hand), `zero_force` (the motors compensate gravity),
    # `held` (the motors hold position)
    hold: Literal["torque_free", "zero_force", "held"] = "torque_free"
    # positions [rad or m] of other joints between camera and marker, which stand still; 0 where not named
    held_at: dict[str, float] = {}


class CameraSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [camera]: the measurement frame, and the stereo geometry if there is one."""

    # the link that the cameras are mounted on: the base, a head, a flange. Joints between it and the marker belong into
    # `joints`.
    parent_link: str
    # xyz, rpy: pose of the left optical frame in it [m], [rad], URDF convention
    xyz: Vector3 = (0.0, 0.0, 0.0)
    rpy: Vector3 = (0.0, 0.0, 0.0)
    pose_known: bool = True  # false: `xyz` and `rpy` are a guess and are fitted first
    eyes: Literal[1, 2] = 2  # 2 of a stereo pair, 1 of a single camera
    focal_px: Positive | None = None  # of the rectified stereo pair [px]; this and the next three, or none of them
    principal_point_px: tuple[float, float] | None = None  # column and row [px]; pixel centres are integers
    baseline_m: Positive | None = None  # distance of the cameras [m]; not with `eyes = 1`
    image_size_px: ImageSize | None = None  # width and height [px]
    pixel_sigma: Positive = 0.2  # 1-sigma of a marker centre's image coordinates [px]

    @property
    def pose(self) -> FloatArray:
        """Pose of the left optical frame in the parent link, shape (4, 4)."""
        return pose_of(np.array(self.xyz), np.array(self.rpy))


@dataclass(frozen=True)
class RobotDescription:
    """The nominal model of a robot, from its files."""

    file: Path  # robot.toml
    robot: RobotSection
    camera: CameraSection
    tree: UrdfTree
    chain: RigidChain  # measurement frame to marker over `joints`
    # lower, upper: joint limits [rad or m], shape (d,)
    lower: FloatArray
    upper: FloatArray
    calibration: StereoCalibration | None  # the stereo pair or the one camera, or None when [camera] describes neither

    @classmethod
    def load(cls, file: Path) -> RobotDescription:
        """Read robot.toml and its URDF; the daemon checks the tables other than [robot] and [camera].

        Raises:
            ConfigError: robot.toml cannot be read, or has an unknown, missing or wrong key (with its line).
            RobotError: URDF and robot.toml do not fit each other.
        """
        tables, text = read_toml(file)
        return cls.from_tables(tables, text, file)

    @classmethod
    def from_tables(cls, tables: dict[str, Any], text: str, file: Path) -> RobotDescription:
        """Build the description like `load`, from the tables and the text of robot.toml."""
        for section in ("robot", "camera"):
            if section not in tables:
                raise ConfigError(f"the table [{section}] is missing", file=file, remedy="`bodyschema init` shows one")
        _check_name(tables["robot"], text, file)
        robot = convert(tables["robot"], RobotSection, file=file, text=text, prefix=("robot",))
        camera = convert(tables["camera"], CameraSection, file=file, text=text, prefix=("camera",))
        return cls._assemble(robot, camera, text, file)

    def with_placement(self, T_parent_camera: FloatArray, marker_xyz: FloatArray) -> RobotDescription:
        """Return a copy with the camera at a pose (4, 4) in its parent link and the marker at (3,) [m] in its link."""
        x, y, z = T_parent_camera[:3, 3].tolist()
        roll, pitch, yaw = rpy_of(T_parent_camera[:3, :3]).tolist()
        camera = msgspec.structs.replace(self.camera, xyz=(x, y, z), rpy=(roll, pitch, yaw))
        robot = msgspec.structs.replace(self.robot, marker_xyz=tuple(marker_xyz.tolist()))
        return replace(self, robot=robot, camera=camera, chain=_chain(self.tree, robot, camera))

    @classmethod
    def _assemble(cls, robot: RobotSection, camera: CameraSection, text: str, file: Path) -> RobotDescription:
        blamed_on = partial(_blamed_on, file, text)
        with blamed_on("robot", "joints"):
            if len(set(robot.joints)) != len(robot.joints):
                raise RobotError("joints names a joint twice", remedy="Name each once")
        tree = _tree(file, robot, text)
        limits = []
        for name in robot.joints:
            with blamed_on("robot", "joints", naming=name):
                limits.append(joint := tree.joint(name))
                if joint.kind not in MOVING:
                    raise RobotError(f"joint {name!r} is fixed", remedy="Take it out of joints")
        for name in robot.held_at:
            with blamed_on("robot", "held_at", name):
                tree.joint(name)
        with blamed_on("camera", "parent_link"):
            tree.require_link(camera.parent_link)
        with blamed_on("robot", "marker_link"):
            tree.require_link(robot.marker_link)
        _check_units(robot, camera, text, file)
        with blamed_on("robot", "joints"):
            chain = _chain(tree, robot, camera)
        with blamed_on("camera"):
            calibration = _calibration(camera)
        return cls(
            file=file,
            robot=robot,
            camera=camera,
            tree=tree,
            chain=chain,
            lower=frozen_array([joint.lower for joint in limits]),
            upper=frozen_array([joint.upper for joint in limits]),
            calibration=calibration,
        )

    @property
    def name(self) -> str:
        return self.robot.name

    @property
    def limits(self) -> list[tuple[float, float]]:
        """Lower and upper limit of each joint [rad; m for a prismatic joint]."""
        return list(zip(self.lower.tolist(), self.upper.tolist(), strict=True))

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in the order of q."""
        return self.robot.joints


def _tree(file: Path, robot: RobotSection, text: str) -> UrdfTree:
    """Read the URDF; an error also names the line of robot.toml that refers to the file."""
    try:
        return UrdfTree.load(file.parent / robot.urdf)
    except RobotError as error:
        line = line_of(text, ("robot", "urdf"))
        named = f"It is named by robot.urdf in {file.name}{'' if line is None else f', line {line}'}"
        remedy = f"{error.remedy}. {named}" if error.remedy else named
        raise RobotError(error.what, file=error.file, line=error.line, remedy=remedy) from error


def _chain(tree: UrdfTree, robot: RobotSection, camera: CameraSection) -> RigidChain:
    return chain_between(
        tree,
        robot.joints,
        robot.held_at,
        start=camera.parent_link,
        end=robot.marker_link,
        T_start_camera=camera.pose,
        marker_xyz=np.array(robot.marker_xyz),
    )


def _check_name(table: Any, text: str, file: Path) -> None:
    """Raise ConfigError in plain words instead of a pattern."""
    name = table.get("name") if isinstance(table, dict) else None
    if isinstance(name, str) and not re.match(NAME, name):
        raise ConfigError(
            f"robot.name: {name!r} is no name for zenoh keys",
            file=file,
            line=line_of(text, ("robot", "name")),
            remedy="Take letters, digits, _ . and -, without spaces, and begin with a letter, a digit or _",
        )


def _check_units(robot: RobotSection, camera: CameraSection, text: str, file: Path) -> None:
    """Raise ConfigError if a number looks like degrees or millimetres."""

    def refuse(keys: tuple[str, str], value: object, unit: str, remedy: str) -> None:
        what = f"{'.'.join(keys)} = {value}: this looks like {unit}"
        raise ConfigError(what, file=file, line=line_of(text, keys), remedy=remedy)

    if max(map(abs, camera.rpy)) > LARGEST_TURN_RAD:
        refuse(("camera", "rpy"), list(camera.rpy), "degrees", "Give radians: a right angle is 1.5708")
    for keys, length, largest in (
        (("robot", "marker_xyz"), robot.marker_xyz, LONGEST_TOOL_M),
        (("camera", "xyz"), camera.xyz, FARTHEST_CAMERA_M),
        (("camera", "baseline_m"), (camera.baseline_m or 0.0,), LONGEST_TOOL_M),
    ):
        if math.hypot(*length) > largest:
            refuse(keys, list(length) if len(length) > 1 else length[0], "millimetres", "Give metres")


def _calibration(camera: CameraSection) -> StereoCalibration | None:
    parts = {
        "focal_px": camera.focal_px,
        "principal_point_px": camera.principal_point_px,
        "image_size_px": camera.image_size_px,
    }
    if camera.eyes == 2:
        parts["baseline_m"] = camera.baseline_m
    elif camera.baseline_m is not None:
        raise RobotError("one eye alone has no baseline_m", remedy="Take out baseline_m, or eyes = 1")
    missing = [name for name, value in parts.items() if value is None]
    if len(missing) == len(parts):
        return None
    if missing:
        what = "stereo camera" if camera.eyes == 2 else "camera"
        alone = "; a camera without a second one is eyes = 1" if missing == ["baseline_m"] else ""
        raise RobotError(
            f"the {what} is described in part: {', '.join(missing)} missing", remedy=f"Give all or none{alone}"
        )
    return StereoCalibration(**{"baseline_m": 0.0} | parts, pixel_sigma=camera.pixel_sigma)  # pyright: ignore[reportArgumentType]


@contextmanager
def _blamed_on(file: Path, text: str, *keys: str, naming: str | None = None) -> Iterator[None]:
    """Add `file` and the line of the key, or of `naming` in its value, to RobotErrors that name no file."""
    try:
        yield
    except RobotError as error:
        if error.file is not None:
            raise
        line = line_of(text, keys)
        if line is not None and naming is not None:
            lines = enumerate(text.splitlines()[line - 1 :], line)
            line = next((k for k, found in lines if f'"{naming}"' in found or f"'{naming}'" in found), line)
        raise RobotError(error.what, file=file, line=line, remedy=error.remedy) from None


def link_poses(robot: RobotDescription, q: FloatArray) -> dict[str, FloatArray]:
    """Return the poses (n, 4, 4) of all links in the root link's frame at readings q (n, d), parents first.

    Joints that are not among the robot's are at the position that robot.toml holds them at, otherwise at 0.
    """
    columns = dict(zip(robot.joints, q.T, strict=True))
    below: dict[str, list[UrdfJoint]] = {link: [] for link in robot.tree.links}
    for joint in robot.tree.joints.values():
        below[joint.parent].append(joint)
    children = {joint.child for joint in robot.tree.joints.values()}
    poses = {link: np.tile(np.eye(4), (len(q), 1, 1)) for link in below if link not in children}
    for link in (open_ := list(poses)):  # grows during the loop
        for joint in below[link]:
            held = np.full(len(q), robot.robot.held_at.get(joint.name, 0.0))
            poses[joint.child] = (
                poses[link] @ joint.T_parent_joint @ joint_transforms(joint, columns.get(joint.name, held))
            )
            open_.append(joint.child)
    return poses
