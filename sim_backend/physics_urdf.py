"""The true robot as URDF text that pybullet can load from anywhere."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from interfaces.errors import RobotError
from interfaces.limited import read_at_most
from interfaces.urdf import UrdfJoint

from .roles import root_link
from .truth import TrueRobot

# The link above the robot's root. It has no inertia, so that the world frame is the root's frame for pybullet too.
WORLD_LINK = "bodyschema_world"
MESHES = (".stl", ".obj", ".dae")


def physics_urdf(truth: TrueRobot) -> str:
    """The URDF of `truth`: joint frames replaced by the true ones, joints that are not learnt locked.

    Mesh files get absolute paths, links that state no inertia a small one. Textures are left out: no other file of the
    machine's is read because a URDF names it.

    Raises:
        RobotError: a mesh file is missing, or is none.
    """
    file = truth.tree.file
    root = ElementTree.fromstring(read_at_most(file))  # `UrdfTree.load` has refused entities and the like
    for element in root.iterfind("joint"):
        _set_joint(element, truth.tree.joints[element.attrib["name"]])
    for mesh in root.iter("mesh"):
        mesh.set("filename", str(_mesh_file(mesh.get("filename", ""), file)))
    for material in root.iter("material"):
        for texture in material.findall("texture"):
            material.remove(texture)
    for link in root.iterfind("link"):
        if link.find("inertial") is None:
            link.append(_small_inertia())
    _add_world(root, root_link(truth.tree))
    return ElementTree.tostring(root, encoding="unicode")


def _set_joint(element: ElementTree.Element, joint: UrdfJoint) -> None:
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    rotation = Rotation.from_matrix(joint.T_parent_joint[:3, :3])
    origin.set("xyz", _numbers(joint.T_parent_joint[:3, 3]))
    origin.set("rpy", _numbers(rotation.as_euler("xyz")))
    element.set("type", joint.kind)
    for name in ("mimic", "safety_controller", "dynamics"):
        for child in element.findall(name):
            element.remove(child)
    axis = element.find("axis")
    if axis is not None:
        axis.set("xyz", _numbers(joint.axis))


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def _small_inertia() -> ElementTree.Element:
    return ElementTree.fromstring(
        '<inertial><mass value="0.1"/>'
        '<inertia ixx="0.0003" ixy="0" ixz="0" iyy="0.0003" iyz="0" izz="0.0003"/></inertial>'
    )


def _mesh_file(name: str, urdf: Path) -> Path:
    if name.startswith("package://"):
        inside = Path(name.removeprefix("package://"))
        candidates = [parent / part for parent in urdf.resolve().parents for part in (inside, Path(*inside.parts[1:]))]
    else:
        candidates = [urdf.resolve().parent / name.removeprefix("file://")]
    for candidate in candidates:
        if candidate.is_file():
            if candidate.resolve().suffix.lower() not in MESHES:
                raise RobotError(f"the mesh {name!r} is none", file=urdf, remedy=f"Meshes end in {', '.join(MESHES)}")
            return candidate
    raise RobotError(
        f"the mesh {name!r} is missing",
        file=urdf,
        remedy="Put it beside the URDF, or replace it by a box, cylinder or sphere for the simulation",
    )


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
