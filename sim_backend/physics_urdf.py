"""The true robot as a URDF that pybullet can load from anywhere.

pybullet only gets the parts that were parsed here, since malformed numbers and meshes end its process.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from bodyschema.interfaces.errors import RobotError
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.limited import read_at_most
from bodyschema.robot.meshes import MeshLimits, MeshSet, stl_bytes
from bodyschema.robot.rpy import rpy_of
from bodyschema.robot.shapes import floats, rgba_of
from bodyschema.robot.suggest import first_few
from bodyschema.robot.urdf import MOVING, UrdfJoint, UrdfTree

from .bullet import PhysicsUrdf
from .geometry import turn_of_z
from .truth import TrueRobot

# The link above the robot's root. It has no inertia, so that the world frame is the root's frame for pybullet too.
WORLD_LINK = "bodyschema_world"


class UrdfSettings:
    max_links: int = 120  # pybullet's messages hold 128 joints
    longest_name: int = 1000  # pybullet's messages hold 1024 bytes
    farthest_m: float = 100.0  # larger coordinates are not in metres
    heaviest_kg: float = 1e4  # the inertia of a heavier link is not believed
    # A rod in the place of a mesh: its radius as a share of its length, and within what; the shortest one [m].
    rod_share, rod_radius_m, widest_rod_m, shortest_rod_m = 0.1, 0.005, 0.04, 0.01
    # TinyRenderer takes 0.3 µs for a triangle, and a stereo frame is four pictures: 8,000 cost some 10 ms of CPU a
    # frame.
    max_triangles: int = 8_000


_ROD_RGBA = "0.55 0.57 0.6 1"
_SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}


def physics_urdf(truth: TrueRobot) -> PhysicsUrdf:
    """Return the URDF of `truth`: joint frames replaced by the true ones, joints that are not learnt locked.

    Meshes have few triangles. Shapes that cannot be drawn are left out, and links whose meshes are missing or malformed
    become rods between their joints. Links without an inertia get a small one. Textures are left out: no other file of
    the machine is read because a URDF names it.

    Raises:
        RobotError: the robot has more links than pybullet accepts, or joints too far apart.
    """
    return _Writer(truth).written()


class _Inertia(NamedTuple):
    """Content of an <inertial> element: mass [kg], ixx to izz [kg·m²], and its frame [m], [rad]."""

    mass_kg: float
    moments: tuple[float, ...]
    xyz: tuple[float, ...]
    rpy: tuple[float, ...]


_ZERO = (0.0, 0.0, 0.0)
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
# Default for a link without <inertial>.
_SMALL = _Inertia(0.1, (0.0003, 0.0, 0.0, 0.0003, 0.0, 0.0003), _ZERO, _ZERO)


class _Writer:
    def __init__(self, truth: TrueRobot) -> None:
        self._truth, self._file = truth, truth.tree.file
        # `UrdfTree.load` has refused entities and the like.
        self._source = ElementTree.fromstring(read_at_most(self._file))
        self._meshes = Meshes(self._file)
        self._left_out: list[str] = []
        self._rods: set[str] = set()
        self._moving = _moved(truth.robot.tree)
        self._colours = {
            str(material.get("name")): rgba
            for material in self._source.iter("material")
            if (rgba := _rgba(material)) is not None
        }

    def written(self) -> PhysicsUrdf:
        tree = self._truth.tree
        if len(tree.links) > UrdfSettings.max_links:
            raise RobotError(
                f"the simulation takes robots of up to {UrdfSettings.max_links} links, this one has {len(tree.links)}",
                file=self._file,
                remedy="Delete the links that neither carry the cameras nor the marker nor anything that is in the way",
            )
        longest = max((*tree.links, *tree.joints), key=len)
        if len(longest.encode()) > UrdfSettings.longest_name:
            raise RobotError(
                f"the name {longest[:40]!r}... is longer than {UrdfSettings.longest_name} bytes",
                file=self._file,
                remedy="Shorten it",
            )
        robot = ElementTree.Element("robot", name="robot")
        for link in self._source.iterfind("link"):
            self._add_link(robot, link)
        for joint in tree.joints.values():
            self._add_joint(robot, joint)
        _add_world(robot, tree.root)
        files, coarser = self._meshes.files()
        self._drop_missing_meshes(robot, files)
        notes = tuple(sentence for sentence in (*self._notes(), coarser) if sentence)
        ElementTree.indent(robot)  # pybullet breaks lines of more than 8 KiB at any place
        return PhysicsUrdf(ElementTree.tostring(robot, encoding="unicode"), files, notes)

    def _add_link(self, robot: ElementTree.Element, source: ElementTree.Element) -> None:
        name = source.attrib["name"]
        link = ElementTree.SubElement(robot, "link", name=name)
        link.append(self._inertial(source))
        for kind in ("visual", "collision"):
            shapes = list(source.iterfind(kind))
            added = [shape for shape in (self._shape(name, shape) for shape in shapes) if shape is not None]
            lost_mesh = any(shape.find("geometry/mesh") is not None for shape in shapes)
            if shapes and not added and lost_mesh:
                added = list(self._rods_of(name, kind))
            link.extend(added)

    def _inertial(self, source: ElementTree.Element) -> ElementTree.Element:
        inertial = source.find("inertial")
        inertia = _SMALL if inertial is None else _inertia(inertial)
        if inertia is None:
            self._left_out.append(f"the inertia of the link {source.attrib['name']!r}, which no body can have")
            inertia = _SMALL
        element = ElementTree.Element("inertial")
        _add_origin(element, inertia.xyz, inertia.rpy)
        ElementTree.SubElement(element, "mass", value=repr(inertia.mass_kg))
        ElementTree.SubElement(element, "inertia", dict(zip(_MOMENTS, map(repr, inertia.moments), strict=True)))
        return element

    def _shape(self, link: str, source: ElementTree.Element) -> ElementTree.Element | None:
        """Return a <visual> or <collision> converted for pybullet; None if it cannot be rendered."""
        geometry = source.find("geometry/*")
        pose = _origin(source)
        if geometry is None or pose is None:
            self._left_out.append(f"a {source.tag} of the link {link!r} without geometry or place")
            return None
        element = _shape_at(source.tag, *pose)
        into = ElementTree.SubElement(element, "geometry")
        if geometry.tag == "mesh":
            scale = floats(geometry.get("scale", "1 1 1"), 3)
            if scale is None or not all(scale):
                self._left_out.append(f"a mesh of the link {link!r} with the scale {geometry.get('scale')!r}")
                return None
            name = self._meshes.add(geometry.get("filename", ""), scale, drawn=source.tag == "visual")
            if name is None:
                return None
            ElementTree.SubElement(into, "mesh", filename=name)
        else:
            sizes = {key: _sizes(geometry.get(key), 3 if key == "size" else 1) for key in _SIZES.get(geometry.tag, ())}
            if not sizes or not all(sizes.values()):
                self._left_out.append(f"a {geometry.tag} of the link {link!r} with an invalid size")
                return None
            ElementTree.SubElement(into, geometry.tag, {key: _numbers(size or ()) for key, size in sizes.items()})
        if source.tag == "visual":
            _add_colour(element, self._colour(source))
        return element

    def _colour(self, visual: ElementTree.Element) -> str | None:
        material = visual.find("material")
        if material is None:
            return None
        return _rgba(material) or self._colours.get(str(material.get("name")))

    def _rods_of(self, link: str, kind: str) -> Iterator[ElementTree.Element]:
        """Yield rods from a link's frame to the joints that lead to others; one to a tool would hide the marker."""
        self._rods.add(link)
        for joint in self._truth.tree.joints.values():
            end = joint.T_parent_joint[:3, 3]
            length = float(np.linalg.norm(end))
            if joint.parent != link or length < UrdfSettings.shortest_rod_m or joint.child not in self._moving:
                continue
            rod = _shape_at(kind, (end / 2).tolist(), rpy_of(turn_of_z(end / length)).tolist())
            thinnest, widest = UrdfSettings.rod_radius_m, UrdfSettings.widest_rod_m
            radius = float(np.clip(UrdfSettings.rod_share * length, thinnest, widest))
            ElementTree.SubElement(
                ElementTree.SubElement(rod, "geometry"), "cylinder", radius=repr(radius), length=repr(length)
            )
            if kind == "visual":
                _add_colour(rod, _ROD_RGBA)
            yield rod

    def _add_joint(self, robot: ElementTree.Element, joint: UrdfJoint) -> None:
        place = joint.T_parent_joint[:3, 3]
        if np.abs(place).max() > UrdfSettings.farthest_m:
            raise RobotError(
                f"joint {joint.name!r} is {np.linalg.norm(place):.3g} m from the joint before it",
                file=self._file,
                remedy="Give metres",
            )
        element = ElementTree.SubElement(robot, "joint", name=joint.name, type=joint.kind)
        ElementTree.SubElement(element, "parent", link=joint.parent)
        ElementTree.SubElement(element, "child", link=joint.child)
        _add_origin(element, place.tolist(), rpy_of(joint.T_parent_joint[:3, :3]).tolist())
        ElementTree.SubElement(element, "axis", xyz=_numbers(joint.axis))
        if joint.kind in ("revolute", "prismatic"):
            limits = {"lower": repr(joint.lower), "upper": repr(joint.upper), "effort": "1000", "velocity": "10"}
            ElementTree.SubElement(element, "limit", limits)

    def _drop_missing_meshes(self, robot: ElementTree.Element, files: dict[str, bytes]) -> None:
        """Drop the shapes of meshes that have no triangles left after simplification: screws."""
        for link in robot.iterfind("link"):
            for shape in link.findall("visual"):
                mesh = shape.find("geometry/mesh")
                if mesh is not None and mesh.get("filename") not in files:
                    link.remove(shape)

    def _notes(self) -> Iterator[str]:
        drawn = f", and draws rods for {first_few(sorted(self._rods))}" if self._rods else ""
        meshes = self._meshes
        if meshes.missing:
            yield (
                f"missing meshes: {first_few(meshes.missing)}. The simulation continues without{drawn}. It only looks "
                f"different. To see the robot's shape, put its meshes beside {self._file}"
            )
            drawn = ""
        if meshes.unusable:
            faults = [f"{name}: {why}" for name, why in meshes.unusable.items()]
            yield f"meshes that cannot be used: {first_few(faults, '; ')}. The simulation continues without{drawn}"
        if self._left_out:
            left_out = first_few(list(dict.fromkeys(self._left_out)), "; ")
            yield f"the simulation leaves out what it cannot take of {self._file}: {left_out}"


class Meshes(MeshSet):
    """The meshes of one URDF as files. Ask for each with `add`, then take all of them with `files`."""

    def __init__(self, urdf: Path) -> None:
        super().__init__(urdf, UrdfSettings.max_triangles)
        self._visual_numbers: list[int] = []

    def add(self, name: str, scale: tuple[float, ...], *, drawn: bool) -> str | None:
        """Return the name of the file that will show the mesh `name`, or its hull; None if it cannot be used.

        Args:
            scale: factors of x, y and z.
            drawn: True for its appearance, False for its convex hull, which pybullet uses for collisions.
        """
        number = self.number_of(name, scale)
        if number is None:
            return None
        if drawn:
            self._visual_numbers.append(number)
        return f"{'drawn' if drawn else 'hull'}_{number}.stl"

    def files(self) -> tuple[dict[str, bytes], str]:
        """Return the files by name, and a sentence on their simplification, if any."""
        drawn, before = self.coarser(self._visual_numbers)
        files = {}
        for number, triangles in enumerate(self.shapes):
            if len(drawn.get(number, ())):
                files[f"drawn_{number}.stl"] = stl_bytes(drawn[number])
            files[f"hull_{number}.stl"] = stl_bytes(_hull(triangles))
        count = sum(len(drawn[number]) for number in self._visual_numbers)
        coarser = f"the meshes have {before:,} triangles. To be quick, the simulation draws the robot with {count:,}"
        return files, coarser if count < before else ""


@cache
def _directions() -> FloatArray:
    """Return unit vectors (106, 3), evenly spread: Fibonacci's sphere and the axes."""
    turns, heights = np.pi * (1.0 + 5.0**0.5) * np.arange(100), np.linspace(-1.0, 1.0, 100)
    radii = np.sqrt(1.0 - heights**2)
    sphere = np.column_stack([radii * np.cos(turns), radii * np.sin(turns), heights])
    return np.vstack([sphere, np.eye(3), -np.eye(3)])


def _hull(triangles: FloatArray) -> FloatArray:
    """Return roughly the convex hull of triangles as triangles (m, 3, 3); for flat ones their box, 1 mm thick.

    It is used for collisions, and is the hull of the outermost points in some directions.
    """
    from scipy.spatial import ConvexHull, QhullError  # only large meshes need it, and it takes half a second

    points = triangles.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    corners = points[np.unique((points @ _directions().T).argmax(axis=0))]
    try:
        return corners[ConvexHull(corners).simplices]
    except (QhullError, ValueError):
        high = np.maximum(high, low + 0.001)
        box = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        return box[ConvexHull(box).simplices]


def _moved(tree: UrdfTree) -> set[str]:
    """Return the child links of moving joints, and the links between them and the root."""
    moved = {joint.child for joint in tree.joints.values() if joint.kind in MOVING}
    above = {joint.child: joint.parent for joint in tree.joints.values()}
    for link in tuple(moved):
        while (link := above.get(link, link)) in above and link not in moved:
            moved.add(link)
    return moved


def _shape_at(kind: str, xyz: Sequence[float], rpy: Sequence[float]) -> ElementTree.Element:
    element = ElementTree.Element(kind)
    _add_origin(element, xyz, rpy)
    return element


def _add_origin(element: ElementTree.Element, xyz: Sequence[float], rpy: Sequence[float]) -> None:
    ElementTree.SubElement(element, "origin", xyz=_numbers(xyz), rpy=_numbers(rpy))


def _add_colour(visual: ElementTree.Element, rgba: str | None) -> None:
    if rgba is not None:
        # A material of one name has one colour.
        material = ElementTree.SubElement(visual, "material", name=f"rgba {rgba}")
        ElementTree.SubElement(material, "color", rgba=rgba)


def _numbers(values: Sequence[float] | FloatArray) -> str:
    return " ".join(repr(float(value)) for value in values)


def _sizes(text: str | None, count: int) -> tuple[float, ...] | None:
    """Return the `count` lengths [m] in a text, each possible for a link; None if the text is anything else."""
    values = floats(text, count)
    return values if values is not None and all(0.0 < value <= MeshLimits.largest_m for value in values) else None


def _origin(element: ElementTree.Element) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Return xyz and rpy of an element's <origin>; None if they are invalid or too far from the link."""
    origin = element.find("origin")
    if origin is None:
        return _ZERO, _ZERO
    xyz, rpy = (floats(origin.get(key, "0 0 0"), 3) for key in ("xyz", "rpy"))
    if xyz is None or rpy is None or max(map(abs, chain(xyz, rpy))) > UrdfSettings.farthest_m:
        return None
    return xyz, rpy


def _rgba(material: ElementTree.Element) -> str | None:
    colour = rgba_of(material)
    return None if colour is None else _numbers(colour)


def _inertia(inertial: ElementTree.Element) -> _Inertia | None:
    """Return the content of an <inertial>, a small one if it is all zero; None if it is physically impossible."""
    mass, tensor, pose = inertial.find("mass"), inertial.find("inertia"), _origin(inertial)
    kilograms = (0.0,) if mass is None else floats(mass.get("value"), 1)
    moments = floats(" ".join("0" if tensor is None else tensor.get(key, "0") for key in _MOMENTS), 6)
    if kilograms is None or moments is None or pose is None or not 0.0 <= kilograms[0] <= UrdfSettings.heaviest_kg:
        return None
    if not (kilograms[0] and any(moments)):
        return _SMALL._replace(mass_kg=kilograms[0] or _SMALL.mass_kg, xyz=pose[0])
    xx, xy, xz, yy, yz, zz = moments
    least, _, most = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    heaviest = UrdfSettings.heaviest_kg * MeshLimits.largest_m**2
    return _Inertia(kilograms[0], moments, *pose) if 0.0 < least <= most <= heaviest else None


def _add_world(root: ElementTree.Element, robot_root: str) -> None:
    root.append(
        ElementTree.fromstring(
            f'<link name="{WORLD_LINK}"><inertial><mass value="1"/>'
            '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
        )
    )
    joint = ElementTree.SubElement(root, "joint", name=f"{WORLD_LINK}_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link=WORLD_LINK)
    ElementTree.SubElement(joint, "child", link=robot_root)
