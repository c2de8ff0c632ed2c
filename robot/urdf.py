"""Read a URDF file as a tree of joints, with a parser that fetches and expands nothing.

Only kinematics, limits and masses are read. Meshes are never opened.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.interfaces.errors import RobotError
from bodyschema.interfaces.records import FloatArray, PairLimits, frozen_array
from kbmaps import RigidChain
from kbmaps.rotations import exponentials

from .limited import UnfitFile, read_at_most
from .rpy import rotation_of
from .suggest import did_you_mean, first_few

REVOLUTE = frozenset({"revolute", "continuous"})
MOVING = REVOLUTE | {"prismatic"}


class _Settings:
    max_links = 2000  # a humanoid with hands has a few hundred
    # Realistic axes have length 1 and offsets of metres; squares of these bounds are far from overflow.
    shortest_axis, largest_place_m = 1e-9, 1e6
    max_quoted = 60  # characters of a wrong attribute in a message: one line of a terminal


@dataclass(frozen=True, slots=True)
class UrdfJoint:
    name: str  # of the joint
    kind: str  # revolute, continuous, prismatic or fixed
    # parent, child: its links
    parent: str
    child: str
    T_parent_joint: FloatArray  # pose of the joint's frame in its parent link at zero, shape (4, 4)
    axis: FloatArray  # unit axis in the joint's frame, shape (3,)
    # lower, upper: limits [rad or m]; ±π where a revolute joint has none
    lower: float
    upper: float
    mimics: bool = False  # it moves with another joint, as the second finger of a gripper does


@dataclass(frozen=True, slots=True)
class PointMass:
    mass_kg: float  # the link's mass [kg]
    centre: FloatArray  # its centre of mass in the link's frame [m], shape (3,)


@dataclass(frozen=True, slots=True)
class UrdfTree:
    """The joints of one URDF file by name; every link but the root is the child of exactly one joint."""

    file: Path  # path of the URDF
    name: str  # of the robot
    links: tuple[str, ...]  # names
    joints: dict[str, UrdfJoint]  # by name
    masses: dict[str, PointMass] = field(default_factory=dict)  # of the links that state one, by link

    @classmethod
    def load(cls, file: Path) -> UrdfTree:
        """Read `file`.

        Raises:
            RobotError: the file is missing, not XML, not a URDF, or its links do not form a tree.
        """
        root = parse_urdf(file)
        links = _by_name(root, "link", file)
        joints = {name: _joint(element, file) for name, element in _by_name(root, "joint", file).items()}
        masses = {
            name: _point_mass(name, link, file) for name, link in links.items() if link.find("inertial") is not None
        }
        tree = cls(file, root.get("name", ""), tuple(links), joints, masses)
        tree._check()
        return tree

    @property
    def root(self) -> str:
        """The link that is the child of no joint."""
        children = {joint.child for joint in self.joints.values()}
        return next(link for link in self.links if link not in children)

    def joint(self, name: str) -> UrdfJoint:
        """Return the joint called `name`.

        Raises:
            RobotError: there is none; the message suggests another.
        """
        if name not in self.joints:
            raise RobotError(f"there is no joint {name!r} in {self.file.name}", remedy=did_you_mean(name, self.joints))
        return self.joints[name]

    def require_link(self, name: str) -> None:
        """Raise RobotError with a suggestion if there is no link called `name`."""
        if name not in self.links:
            raise RobotError(f"there is no link {name!r} in {self.file.name}", remedy=did_you_mean(name, self.links))

    def path(self, start: str, end: str) -> list[tuple[UrdfJoint, bool]]:
        """Return the joints between two links in order; the flag is True where the path goes from child to parent."""
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
                f"the links do not form one tree (roots: {first_few(roots) or 'none'})",
                file=self.file,
                remedy="Every link but one needs a joint whose child it is",
            )
        reached = list(roots)
        for link in reached:  # the list grows during the loop
            reached += below[link]
        ring = sorted(links.difference(reached))
        if ring:
            raise RobotError(
                f"the links {first_few(ring)} hang on each other in a ring",
                file=self.file,
                remedy="Every link but one needs a joint whose parent is nearer to the root",
            )


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
    """Return the rigid chain from the measurement frame to the marker.

    Args:
        joints: names in the order of q; each has to lie between the two links.
        held_at: positions [rad or m] of the other joints on the path; 0 if not named.
        T_start_camera: pose of the measurement frame in `start`, shape (4, 4).
        marker_xyz: position of the marker in `end` [m], shape (3,).

    Returns:
        A chain whose joints are `joints`, in this order, which is also their order along the path.

    Raises:
        RobotError: a joint does not lie between the links, or their order along the path differs.
    """
    path = tree.path(start, end)
    mimicking = next((joint for joint, _ in path if joint.mimics), None)
    if mimicking is not None:
        raise RobotError(
            f"joint {mimicking.name!r} mimics another joint", file=tree.file, remedy="Replace it by a fixed joint"
        )
    on_path = [joint.name for joint, _ in path if joint.name in joints]
    for name in joints:
        tree.joint(name)
        if name not in on_path:
            movable = ", ".join(joint.name for joint, _ in path if joint.kind in MOVING) or "none"
            raise RobotError(
                f"joint {name!r} does not move the marker: it is not between the links {start!r} and {end!r}",
                remedy=f"Take it out of joints (between them are: {movable})",
            )
    if tuple(on_path) != joints:
        raise RobotError(
            f"joints are not in the order in which they follow from {start!r} to {end!r}",
            remedy=f"Write joints = {list(on_path)}",
        )
    return _assemble(path, joints, held_at, inverse(T_start_camera), marker_xyz)


def _assemble(
    path: list[tuple[UrdfJoint, bool]],
    joints: tuple[str, ...],
    held_at: dict[str, float],
    T_camera_start: FloatArray,
    marker_xyz: FloatArray,
) -> RigidChain:
    fixed, axes, prismatic = [T_camera_start], [], []
    for joint, upward in path:
        T_joint_parent = inverse(joint.T_parent_joint)
        if joint.name in joints:
            if not upward:
                fixed[-1] = fixed[-1] @ joint.T_parent_joint
            fixed.append(T_joint_parent if upward else np.eye(4))
            axes.append(-joint.axis if upward else joint.axis)
            prismatic.append(joint.kind == "prismatic")
            continue
        fixed[-1] = fixed[-1] @ fixed_transform(joint, upward, held_at.get(joint.name, 0.0))
    tool = np.eye(4)
    tool[:3, 3] = marker_xyz
    fixed[-1] = fixed[-1] @ tool
    return RigidChain(
        fixed=np.array(fixed), axes=np.array(axes).reshape(-1, 3), prismatic=np.array(prismatic, dtype=bool)
    )


def fixed_transform(joint: UrdfJoint, upward: bool, position: float) -> FloatArray:
    """Return the transform (4, 4) across a joint that is held at `position` [rad or m]."""
    T_parent_child = joint.T_parent_joint @ joint_transforms(joint, np.array([position]))[0]
    return inverse(T_parent_child) if upward else T_parent_child


def joint_transforms(joint: UrdfJoint, positions: FloatArray) -> FloatArray:
    """Return the transforms (n, 4, 4) of a joint's motion at positions (n,) [rad or m]."""
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    moved = positions[:, None] * joint.axis
    if joint.kind in REVOLUTE:
        T[:, :3, :3] = exponentials(moved)[0]
    elif joint.kind == "prismatic":
        T[:, :3, 3] = moved
    return T


def joint_motion(axis: FloatArray, prismatic: bool, value: float) -> FloatArray:
    """Return the transform (4, 4) of a joint at `value`: a rotation about its axis [rad] or a slide along it [m]."""
    T = np.eye(4)
    if prismatic:
        T[:3, 3] = value * axis
    else:
        T[:3, :3] = exponentials((value * axis)[None])[0][0]
    return T


def inverse(T: FloatArray) -> FloatArray:
    """Return the inverse of a transform (4, 4)."""
    return np.linalg.inv(T).astype(np.float64)


def _wrong(element: Any, file: Path, what: str, remedy: str = "") -> RobotError:
    return RobotError(what, file=file, line=element.sourceline, remedy=remedy)


def _joint(element: Any, file: Path) -> UrdfJoint:
    name, kind = element.get("name"), element.get("type", "")
    if kind not in MOVING | {"fixed"}:
        remedy = "Use revolute, continuous, prismatic or fixed joints"
        raise _wrong(element, file, f"joint {name!r} is of the type {kind!r}", remedy)
    axis = _numbers(element.find("axis"), "xyz", (1.0, 0.0, 0.0), file)
    length = math.hypot(*axis)  # hypot does not overflow
    if kind != "fixed" and not _Settings.shortest_axis < length < 1.0 / _Settings.shortest_axis:
        what = "no length" if length == 0 else f"the length {length:.3g}"
        raise _wrong(element, file, f"the axis of joint {name!r} has {what}", 'Write <axis xyz="0 0 1"/>')
    lower, upper = _limits(element, kind, file)
    if lower > upper:
        raise _wrong(element, file, f"joint {name!r} has its lower limit above its upper one", "Swap them")
    return UrdfJoint(
        name=name,
        kind=kind,
        parent=_link_named(element, "parent", file),
        child=_link_named(element, "child", file),
        T_parent_joint=frozen_array(_origin(element, file)),
        axis=frozen_array(axis / (length or 1.0)),
        lower=lower,
        upper=upper,
        mimics=element.find("mimic") is not None,
    )


def _point_mass(name: str, link: Any, file: Path) -> PointMass:
    inertial = link.find("inertial")
    [mass] = _numbers(inertial.find("mass"), "value", (0.0,), file)
    if mass < 0.0:
        raise _wrong(inertial, file, f"link {name!r} has a mass of {mass:g} kg", "Give a mass of 0 or more")
    return PointMass(float(mass), frozen_array(_origin(inertial, file)[:3, 3]))


def _limits(joint: Any, kind: str, file: Path) -> tuple[float, float]:
    limit = joint.find("limit")
    if kind == "continuous" or limit is None or limit.get("lower") is None or limit.get("upper") is None:
        return -np.pi, np.pi
    [lower], [upper] = (_numbers(limit, side, (0.0,), file) for side in ("lower", "upper"))
    if kind == "prismatic" and max(abs(lower), abs(upper)) > _Settings.largest_place_m:
        what = f"<limit> of {_owner(limit)} lets it slide {max(abs(lower), abs(upper)):.3g} m away"
        raise _wrong(limit, file, what, "Give metres")
    if kind != "prismatic" and max(abs(lower), abs(upper)) > PairLimits.largest_q:
        what = f"<limit> of {_owner(limit)} lets it turn by {max(abs(lower), abs(upper)):.3g} rad"
        raise _wrong(limit, file, what, 'Give radians, or write type="continuous"')
    return float(lower), float(upper)


def _origin(element: Any, file: Path) -> FloatArray:
    """Return the pose (4, 4) of the <origin> in `element`; the identity if there is none."""
    origin = element.find("origin")
    T = np.eye(4)
    rpy = _numbers(origin, "rpy", (0.0, 0.0, 0.0), file)
    if np.abs(rpy).max() > PairLimits.largest_q:  # no digits are left of its part of a turn
        what = f"the <origin> of {_owner(origin)} is turned by {np.abs(rpy).max():.3g} rad"
        raise _wrong(origin, file, what, "Give radians")
    T[:3, :3] = rotation_of(rpy)
    T[:3, 3] = _numbers(origin, "xyz", (0.0, 0.0, 0.0), file)
    if np.abs(T[:3, 3]).max() > _Settings.largest_place_m:
        what = f"the <origin> of {_owner(origin)} is {np.abs(T[:3, 3]).max():.3g} m away"
        raise _wrong(origin, file, what, "Give metres")
    return T


def _numbers(element: Any, attribute: str, default: tuple[float, ...], file: Path) -> FloatArray:
    """Return the finite numbers in an attribute, as many as `default` has, which replaces a missing attribute."""
    if element is None or element.get(attribute) is None:
        return np.array(default)
    text = element.get(attribute)
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != len(default) or not np.isfinite(numbers).all():
        wanted = "a finite number" if len(default) == 1 else f"{len(default)} finite numbers"
        raise _wrong(element, file, f"<{element.tag} {attribute}={_short(text)}> of {_owner(element)} is not {wanted}")
    return numbers


def _short(text: str) -> str:
    return repr(text if len(text) <= _Settings.max_quoted else text[: _Settings.max_quoted] + "...")


def _owner(element: Any) -> str:
    """Return the joint or link around `element`, as named in an error."""
    for above in element.iterancestors("joint", "link"):
        return f"{above.tag} {_short(above.get('name', ''))}"
    return "the robot"


def _by_name(root: Any, tag: str, file: Path) -> dict[str, Any]:
    """Return the elements of one kind under the root, by their names."""
    found: dict[str, Any] = {}
    for element in root.iterfind(tag):
        name = element.get("name")
        if not name:
            raise _wrong(element, file, f"a <{tag}> has no name")
        if name in found:
            raise _wrong(element, file, f"two {tag}s have the same name, {name!r}", "Rename one of them")
        found[name] = element
    return found


def _link_named(joint: Any, end: str, file: Path) -> str:
    found = joint.find(end)
    link = None if found is None else found.get("link")
    if not link:
        what = f"joint {joint.get('name')!r} names no {end} link"
        raise _wrong(joint, file, what, f'Write <{end} link="..."/> in it')
    return link


def parse_urdf(file: Path) -> Any:
    """Return the root element of a URDF, parsed without entities and network; RobotError if it cannot be read."""
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    try:
        data = read_at_most(file)
    except UnfitFile as error:
        raise RobotError(
            f"the URDF is {error.strerror}", file=file, remedy="Keep meshes in files of their own"
        ) from error
    except OSError as error:
        raise RobotError(
            f"cannot read the URDF: {error.strerror}", file=file, remedy="Fix [robot] urdf, or --urdf"
        ) from error
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        what = " ".join(error.msg.removesuffix(f", line {error.lineno}, column {error.offset}").split())
        raise RobotError(f"not XML: {what}", file=file, line=error.lineno) from error
    if root.getroottree().docinfo.doctype:
        raise RobotError("a URDF with a DOCTYPE is not accepted", file=file, line=1, remedy="Delete the DOCTYPE")
    if root.tag != "robot":
        raise _wrong(root, file, f"the root element is <{root.tag}>, not <robot>")
    macro = next((element for element in root.iter("{*}*") if "xacro" in str(etree.QName(element).namespace)), None)
    if macro is not None:
        remedy = f"With ROS: `xacro {file.name} > made.urdf`, with the arguments that its makers document; then set "
        what = "this is a xacro file, of which a URDF is made first"
        raise _wrong(macro, file, what, f'{remedy}urdf = "made.urdf" in [robot]')
    if sum(1 for _ in root.iter("link", "joint")) > 2 * _Settings.max_links:
        what = f"the URDF has more than {_Settings.max_links:,} links"
        raise RobotError(what, file=file, remedy="Keep the arm's alone")
    return root
