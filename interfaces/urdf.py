"""A URDF file as a tree of joints, read by yourdfpy behind a parser that fetches and expands nothing.

Meshes are never loaded: kinematics and limits are all that is asked of the file here.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from kbmaps import RigidChain

from .errors import RobotError
from .limited import UnfitFile, read_at_most
from .records import FloatArray, frozen_array
from .suggest import did_you_mean

REVOLUTE = frozenset({"revolute", "continuous"})
MOVING = REVOLUTE | {"prismatic"}
MOST_LINKS = 2000  # a humanoid with hands has some hundred


@dataclass(frozen=True, slots=True)
class UrdfJoint:
    """One joint of a URDF.

    Attributes:
        kind: revolute, continuous, prismatic or fixed.
        T_parent_joint: pose of the joint's frame in its parent link at zero, shape (4, 4).
        axis: unit axis in the joint's frame, shape (3,).
        lower, upper: limits [rad or m]; ±π where a revolute joint has none.
    """

    name: str
    kind: str
    parent: str
    child: str
    T_parent_joint: FloatArray
    axis: FloatArray
    lower: float
    upper: float


@dataclass(frozen=True, slots=True)
class PointMass:
    """What gravity takes hold of in a link.

    Attributes:
        mass_kg: the link's mass [kg].
        centre: its centre of mass in the link's frame [m], shape (3,).
    """

    mass_kg: float
    centre: FloatArray


@dataclass(frozen=True, slots=True)
class UrdfTree:
    """The joints of one URDF file by name; every link but the root has exactly one joint above it.

    Attributes:
        masses: of the links that state one, by link.
    """

    file: Path
    name: str
    links: tuple[str, ...]
    joints: dict[str, UrdfJoint]
    masses: dict[str, PointMass] = field(default_factory=dict)

    @classmethod
    def load(cls, file: Path) -> UrdfTree:
        """Read `file`.

        Raises:
            RobotError: the file is missing, not XML, not a URDF, or its links do not form a tree.
        """
        robot = _parse(file)
        joints = {joint.name: _joint(joint, file) for joint in robot.joints}
        if len(joints) != len(robot.joints):
            raise RobotError("two joints have the same name", file=file, remedy="Rename one of them")
        masses = {link.name: _point_mass(link, file) for link in robot.links if link.inertial is not None}
        tree = cls(file, str(robot.name), tuple(link.name for link in robot.links), joints, masses)
        tree._check()
        return tree

    def joint(self, name: str) -> UrdfJoint:
        """The joint called `name`; RobotError with a suggestion when there is none."""
        if name not in self.joints:
            raise RobotError(f"there is no joint {name!r} in {self.file.name}", remedy=did_you_mean(name, self.joints))
        return self.joints[name]

    def require_link(self, name: str) -> None:
        """RobotError with a suggestion when there is no link called `name`."""
        if name not in self.links:
            raise RobotError(f"there is no link {name!r} in {self.file.name}", remedy=did_you_mean(name, self.links))

    def path(self, start: str, end: str) -> list[tuple[UrdfJoint, bool]]:
        """The joints between two links, in order; the flag is True where a joint is walked from child to parent."""
        up, down = self._to_root(start), self._to_root(end)
        while up and down and up[-1] is down[-1]:
            up.pop()
            down.pop()
        return [(joint, True) for joint in up] + [(joint, False) for joint in reversed(down)]

    def _to_root(self, link: str) -> list[UrdfJoint]:
        self.require_link(link)
        above = {joint.child: joint for joint in self.joints.values()}
        joints: list[UrdfJoint] = []
        while link in above:
            joints.append(above[link])
            link = above[link].parent
        return joints

    def _check(self) -> None:
        links, below = set(self.links), {link: list[str]() for link in self.links}
        children: set[str] = set()
        for joint in self.joints.values():
            for link in (joint.parent, joint.child):
                if link not in links:
                    raise RobotError(
                        f"joint {joint.name!r} names the link {link!r}, which is not there", file=self.file
                    )
            if joint.child in children:
                raise RobotError(f"link {joint.child!r} hangs on more than one joint", file=self.file)
            children.add(joint.child)
            below[joint.parent].append(joint.child)
        roots = [link for link in self.links if link not in children]
        if len(roots) != 1:
            raise RobotError(
                f"the links do not form one tree (roots: {_some(roots) or 'none'})",
                file=self.file,
                remedy="Every link but one needs a joint whose child it is",
            )
        reached = list(roots)
        for link in reached:  # grows on the way
            reached += below[link]
        ring = sorted(links.difference(reached))
        if ring:
            raise RobotError(
                f"the links {_some(ring)} hang on each other in a ring",
                file=self.file,
                remedy="Every link but one needs a joint whose parent is nearer to the root",
            )


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")


def chain_between(
    tree: UrdfTree,
    joints: tuple[str, ...],
    held_at: dict[str, float],
    *,
    start: str,
    end: str,
    T_start_camera: FloatArray,
    marker_xyz: FloatArray,
) -> RigidChain:
    """The rigid chain from the measurement frame to the marker.

    Args:
        joints: names in the order of q; each has to lie between the two links.
        held_at: positions [rad or m] of the joints on the way that are not among `joints`; 0 where not named.
        start: the link that carries the camera.
        end: the link that carries the marker.
        T_start_camera: pose of the measurement frame in `start`, shape (4, 4).
        marker_xyz: the marker in `end` [m], shape (3,).

    Returns:
        A chain whose joints are `joints` in their order along the way, and in the order of `joints`.

    Raises:
        RobotError: a joint does not lie between the links, or the order along the way is another one.
    """
    way = tree.path(start, end)
    on_way = [joint.name for joint, _ in way if joint.name in joints]
    for name in joints:
        tree.joint(name)
        if name not in on_way:
            raise RobotError(
                f"joint {name!r} does not move the marker: it is not between the links {start!r} and {end!r}",
                remedy=f"Take it out of joints (between them are: {_movable(way)})",
            )
    if tuple(on_way) != joints:
        raise RobotError(
            f"joints are not in the order in which they follow from {start!r} to {end!r}",
            remedy=f"Write joints = {list(on_way)}",
        )
    return _assemble(way, joints, held_at, inverse(T_start_camera), marker_xyz)


def _assemble(
    way: list[tuple[UrdfJoint, bool]],
    joints: tuple[str, ...],
    held_at: dict[str, float],
    T_camera_start: FloatArray,
    marker_xyz: FloatArray,
) -> RigidChain:
    fixed, axes, prismatic = [T_camera_start], [], []
    for joint, upward in way:
        T_joint_parent = inverse(joint.T_parent_joint)
        if joint.name in joints:
            if not upward:
                fixed[-1] = fixed[-1] @ joint.T_parent_joint
            fixed.append(T_joint_parent if upward else np.eye(4))
            axes.append(-joint.axis if upward else joint.axis)
            prismatic.append(joint.kind == "prismatic")
            continue
        fixed[-1] = fixed[-1] @ standing(joint, upward, held_at.get(joint.name, 0.0))
    tool = np.eye(4)
    tool[:3, 3] = marker_xyz
    fixed[-1] = fixed[-1] @ tool
    return RigidChain(
        fixed=np.array(fixed), axes=np.array(axes).reshape(-1, 3), prismatic=np.array(prismatic, dtype=bool)
    )


def standing(joint: UrdfJoint, upward: bool, position: float) -> FloatArray:
    """What a joint that stands still at `position` [rad or m] adds to the way through it, shape (4, 4)."""
    T_parent_child = joint.T_parent_joint @ _motion(joint, position)
    return inverse(T_parent_child) if upward else T_parent_child


def _motion(joint: UrdfJoint, position: float) -> FloatArray:
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    if joint.kind in REVOLUTE:
        T[:3, :3] = Rotation.from_rotvec(joint.axis * position).as_matrix()
    elif joint.kind == "prismatic":
        T[:3, 3] = joint.axis * position
    return T


def inverse(T: FloatArray) -> FloatArray:
    """The inverse of a transform (4, 4)."""
    return np.linalg.inv(T).astype(np.float64)


def _movable(way: list[tuple[UrdfJoint, bool]]) -> str:
    return ", ".join(joint.name for joint, _ in way if joint.kind in MOVING) or "none"


def _joint(joint: Any, file: Path) -> UrdfJoint:
    if joint.type not in MOVING | {"fixed"}:
        raise RobotError(
            f"joint {joint.name!r} is of the type {joint.type!r}",
            file=file,
            remedy="Use revolute, continuous, prismatic or fixed joints",
        )
    if joint.mimic is not None:
        raise RobotError(f"joint {joint.name!r} mimics another joint", file=file, remedy="Replace it by a fixed joint")
    axis = np.array([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    if joint.type != "fixed" and not length > 0:
        raise RobotError(
            f"the axis of joint {joint.name!r} has no length", file=file, remedy='Write <axis xyz="0 0 1"/>'
        )
    lower, upper = _limits(joint)
    if lower > upper:
        raise RobotError(f"joint {joint.name!r} has its lower limit above its upper one", file=file, remedy="Swap them")
    origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=np.float64)
    if not all(np.isfinite(part).all() for part in (origin, axis, lower, upper)):
        raise RobotError(f"joint {joint.name!r} has a number that is not finite", file=file)
    return UrdfJoint(
        name=joint.name,
        kind=joint.type,
        parent=joint.parent,
        child=joint.child,
        T_parent_joint=frozen_array(origin),
        axis=frozen_array(axis / (length or 1.0)),
        lower=lower,
        upper=upper,
    )


def _point_mass(link: Any, file: Path) -> PointMass:
    mass = 0.0 if link.inertial.mass is None else float(link.inertial.mass)
    origin = np.eye(4) if link.inertial.origin is None else np.asarray(link.inertial.origin, dtype=np.float64)
    if not (np.isfinite(mass) and np.isfinite(origin).all() and mass >= 0.0):
        raise RobotError(
            f"link {link.name!r} has a mass of {mass:g} kg, or a centre of mass that is not finite", file=file
        )
    return PointMass(mass, frozen_array(origin[:3, 3]))


def _limits(joint: Any) -> tuple[float, float]:
    limit = joint.limit
    if joint.type == "continuous" or limit is None or limit.lower is None or limit.upper is None:
        return -np.pi, np.pi
    return float(limit.lower), float(limit.upper)


def _parse(file: Path) -> Any:
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    try:
        data = read_at_most(file)
    except UnfitFile as error:
        raise RobotError(
            f"the URDF is {error.strerror}", file=file, remedy="Keep meshes in files of their own"
        ) from error
    except OSError as error:
        raise RobotError(
            f"cannot read the URDF: {error.strerror}", file=file, remedy="Mend [robot] urdf, or --urdf"
        ) from error
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        what = error.msg.removesuffix(f", line {error.lineno}, column {error.offset}")
        raise RobotError(f"not XML: {what}", file=file, line=error.lineno) from error
    if root.getroottree().docinfo.doctype:
        raise RobotError("a URDF with a DOCTYPE is not accepted", file=file, line=1, remedy="Delete the DOCTYPE")
    if root.tag != "robot":
        raise RobotError(f"the root element is <{root.tag}>, not <robot>", file=file, line=root.sourceline)
    if sum(1 for _ in root.iter("link", "joint")) > 2 * MOST_LINKS:
        raise RobotError(f"the URDF has more than {MOST_LINKS:,} links", file=file, remedy="Keep the arm's alone")
    return _read_robot(data, file)


def _read_robot(data: bytes, file: Path) -> Any:
    from yourdfpy import URDF

    try:
        return URDF.load(io.BytesIO(data), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # yourdfpy raises whatever its conversions raise
        raise RobotError(
            f"not a URDF that can be understood: {error}", file=file, line=_line_of(error, data)
        ) from error


def _line_of(error: Exception, data: bytes) -> int | None:
    """The first line (from 1) that holds the text which the error quotes; None when it quotes none that is there."""
    quoted = re.search(r"'([^']+)'", str(error))
    place = -1 if quoted is None else data.find(quoted[1].encode())
    return None if place < 0 else data.count(b"\n", 0, place) + 1
