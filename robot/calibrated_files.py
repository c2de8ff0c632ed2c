"""A calibrated robot on disk: a URDF and a robot.toml that replace the nominal ones.

The URDF is the nominal file with the learnt joints' origins replaced, and with two more frames: `CAMERA_LINK`, the
measurement frame, and `MARKER_LINK`. So the URDF alone contains the whole chain, without robot.toml.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.whole_files import raising_write_errors, write_atomically

from .calibrated import CalibratedGeometry
from .description import RobotDescription
from .rpy import rpy_of
from .toml_file import read_toml
from .toml_text import toml_text
from .urdf import parse_urdf

CAMERA_LINK = "calibrated_camera"
MARKER_LINK = "calibrated_marker"
ROBOT_FILE = "robot.toml"
# What an extended.toml adds to robot.toml: `bodyschema.effects.files` reads and writes it.
EXTENSIONS = ("effects", "background", "unexplained")
# A negligible mass: simulators give a link without any mass a default one of their own.
_NO_MASS = (
    '<inertial><mass value="1e-6"/><inertia ixx="1e-9" ixy="0" ixz="0" iyy="1e-9" iyz="0" izz="1e-9"/></inertial>'
)
# A state directory of its own: the calibrated robot must not go on from the nominal robot's store and checkpoint.
STATE_DIR = "state"


def write_calibrated(
    robot: RobotDescription, geometry: CalibratedGeometry, folder: Path, heading: str, *, replace: bool = False
) -> Path:
    """Write `robot` with another geometry as a URDF and a robot.toml into `folder`, which is created if necessary.

    Meshes stay in place: their relative names are adapted, and names with a scheme are kept. Store and checkpoint will
    be kept in a separate folder.

    Args:
        heading: one line for the top of both files that states their origin.
        replace: overwrite existing files, except those that the robot was read from.

    Returns:
        The path of the robot.toml.

    Raises:
        ConfigError: one of the files exists already, or they cannot be written.
    """
    urdf, toml = folder / robot.tree.file.name, folder / ROBOT_FILE
    texts = {
        urdf: calibrated_urdf(robot, geometry, folder, heading),
        toml: f"# {heading}\n\n{toml_text(_tables(robot, geometry, folder))}".encode(),
    }
    with raising_write_errors(folder, remedy="Give another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        for file in texts:
            own = file.exists() and any(file.samefile(read) for read in (robot.file, robot.tree.file))
            if own or (file.exists() and not replace):
                remedy = "Give another folder" if own else "Give another folder, or --force"
                raise ConfigError("is there already", file=file, remedy=remedy)
        write_atomically(texts)
    return toml


def calibrated_urdf(robot: RobotDescription, geometry: CalibratedGeometry, folder: Path, heading: str) -> bytes:
    """Return the URDF of `robot` with `geometry`, for a file in `folder`."""
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    root = parse_urdf(robot.tree.file)
    comment = etree.Comment(f" {heading.replace('--', '- -')} ")
    comment.tail = "\n  "
    root.insert(0, comment)
    for joint in root.iterfind("joint"):
        if joint.get("name") in geometry.T_parent_joint:
            _set_origin(etree, joint, geometry.T_parent_joint[joint.get("name")])
    for joint in root.iterfind("joint[axis]"):
        # pybullet would scale the travel of a prismatic joint by the length of its axis.
        element, unit = joint.find("axis"), robot.tree.joint(joint.get("name")).axis
        given = np.array([float(number) for number in element.get("xyz", "1 0 0").split()])
        if not np.allclose(given, unit, rtol=0.0, atol=1e-12):
            element.set("xyz", _numbers(unit))
    for element in (*root.iter("mesh"), *root.iter("texture")):
        if element.get("filename"):
            name = element.get("filename")
            if "://" not in name and not os.path.isabs(name):  # relative to the URDF
                element.set("filename", _relative(name, robot.tree.file.parent, folder))
    T_link_marker = np.eye(4)
    T_link_marker[:3, 3] = geometry.marker_xyz
    _set_frame(etree, root, CAMERA_LINK, robot.camera.parent_link, geometry.T_parent_camera)
    _set_frame(etree, root, MARKER_LINK, robot.robot.marker_link, T_link_marker)
    return etree.tostring(root.getroottree(), encoding="utf-8", xml_declaration=True)


def _set_origin(etree: Any, joint: Any, pose: FloatArray) -> None:
    origin = joint.find("origin")
    if origin is None:
        origin = etree.SubElement(joint, "origin")
    origin.set("xyz", _numbers(pose[:3, 3]))
    origin.set("rpy", _numbers(rpy_of(pose[:3, :3])))


def _set_frame(etree: Any, root: Any, name: str, parent: str, pose: FloatArray) -> None:
    """Add a link fixed to `parent`, in place of one of this name from an earlier calibration."""
    for element in (*root.iterfind("link"), *root.iterfind("joint")):
        if element.get("name") in (name, f"{name}_joint"):
            root.remove(element)
    link = etree.fromstring(f"<link>{_NO_MASS}</link>")
    link.set("name", name)
    joint = etree.Element("joint", name=f"{name}_joint", type="fixed")
    etree.SubElement(joint, "parent", link=parent)
    etree.SubElement(joint, "child", link=name)
    _set_origin(etree, joint, pose)
    for element in (link, joint):
        etree.indent(element, space="  ", level=1)
        root[-1].tail, element.tail = "\n  ", "\n"
        root.append(element)


def _relative(path: str | Path, old: Path, new: Path) -> str:
    """Return `path`, given relative to the folder `old`, relative to the folder `new`."""
    return Path(os.path.relpath(old.resolve() / path, new.resolve())).as_posix()


def tables_elsewhere(robot: RobotDescription, folder: Path) -> dict[str, Any]:
    """Return the tables of a robot.toml in `folder` with the same URDF and its own store.

    Raises:
        ConfigError: the original robot.toml can no longer be read.
    """
    tables, _ = read_toml(robot.file)
    tables["daemon"] = tables.get("daemon", {}) | {"state_dir": STATE_DIR}
    if "recording" in tables.get("drivers", {}):
        tables["drivers"]["recording"] = _relative(tables["drivers"]["recording"], robot.file.parent, folder)
    described = {key: value for key, value in msgspec.to_builtins(robot.robot).items() if value != {}}
    tables["robot"] = described | {"urdf": _relative(robot.robot.urdf, robot.file.parent, folder)}
    camera = msgspec.to_builtins(robot.camera)
    tables["camera"] = {key: value for key, value in camera.items() if value is not None}
    return tables


def _tables(robot: RobotDescription, geometry: CalibratedGeometry, folder: Path) -> dict[str, Any]:
    """Return the tables of the nominal robot.toml with calibrated values instead of the nominal ones."""
    tables = tables_elsewhere(robot, folder)
    for added in EXTENSIONS:  # the geometry was learnt without them
        tables.pop(added, None)
    tables["robot"] |= {"urdf": robot.tree.file.name, "marker_xyz": geometry.marker_xyz.tolist(), "marker_known": True}
    tables["camera"] |= {
        "xyz": geometry.T_parent_camera[:3, 3].tolist(),
        "rpy": rpy_of(geometry.T_parent_camera[:3, :3]).tolist(),
        "pose_known": True,
    }
    return tables


def _numbers(values: FloatArray) -> str:
    return " ".join(map(repr, (values + 0.0).tolist()))  # no minus before a zero
