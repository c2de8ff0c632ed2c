"""Convert the visual shapes of a URDF to MuJoCo's form. Meshes stay in place."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.interfaces.errors import RobotError
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.meshes import STL_HEAD_BYTES, STL_TRIANGLE, find_mesh
from bodyschema.robot.rpy import rotation_of
from bodyschema.robot.shapes import Shape, link_shapes
from bodyschema.robot.urdf import parse_urdf
from kbmaps.rotations import quaternions

# Mesh formats that MuJoCo reads, and its limit of triangles in an STL file.
_MESHES = (".stl", ".obj", ".msh")


class PartSettings:
    max_triangles = 200_000
    rod_radius_m, shortest_rod_m = 0.02, 0.01  # a link without a shape becomes a rod from its joint to the next one [m]
    # Floor of a moment of inertia [kg·m²]; MuJoCo needs a positive one.
    min_inertia_kgm2 = 1e-9


_GREY = "0.7 0.7 0.72 1"


@dataclass(frozen=True)
class LinkParts:
    """Parts of a URDF that only a simulator needs."""

    meshes: list[dict[str, str]]  # attributes of the assets
    geoms: dict[str, list[dict[str, str]]]  # attributes of the geoms, by link
    inertias: dict[str, FloatArray]  # (3, 3) [kg·m²] about the centres of mass, along the links' axes, by link
    # for each mimic joint: the joint it follows, the factor, and the offset [rad, m]
    mimics: dict[str, tuple[str, float, float]]
    unreadable: list[str]  # mesh files that are missing, or that MuJoCo cannot read

    @classmethod
    def of(cls, urdf: Path, folder: Path) -> LinkParts:
        """Read the parts of a checked URDF, for a file in `folder`."""
        root = parse_urdf(urdf)
        shapes = link_shapes(root)
        parts = cls([], {}, {}, {}, [])
        for link in root.iterfind("link"):
            geoms = [parts._geom(shape, urdf, folder) for shape in shapes[link.get("name")]]
            parts.geoms[link.get("name")] = [geom for geom in geoms if geom is not None]
            if link.find("inertial/inertia") is not None:
                with _blamed_on(link, urdf):
                    parts.inertias[link.get("name")] = _inertia(link.find("inertial"))
        for joint in root.iterfind("joint[mimic]"):
            mimic = joint.find("mimic")
            with _blamed_on(joint, urdf):
                numbers = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
            parts.mimics[joint.get("name")] = (mimic.get("joint", ""), *numbers)
        return parts

    def _geom(self, shape: Shape, urdf: Path, folder: Path) -> dict[str, str] | None:
        kind = self._mesh(shape, urdf, folder) if shape.kind == "mesh" else _primitive(shape)
        if kind is None:
            return None
        colour = _GREY if shape.rgba is None else texts(np.array(shape.rgba))
        return kind | placed(shape.T_link_shape) | {"rgba": colour}

    def _mesh(self, shape: Shape, urdf: Path, folder: Path) -> dict[str, str] | None:
        file = find_mesh(shape.mesh, urdf)
        if file is None or not _readable(file):
            self.unreadable.append(shape.mesh)
            return None
        name = f"mesh_{len(self.meshes)}"
        path = Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()
        # MuJoCo computes no mass for a mesh that is not closed; a shell needs no closed mesh.
        mesh = {"name": name, "file": path, "inertia": "shell"}
        if shape.sizes != (1.0, 1.0, 1.0):
            mesh["scale"] = texts(np.array(shape.sizes))
        self.meshes.append(mesh)
        return {"type": "mesh", "mesh": name}


def _primitive(shape: Shape) -> dict[str, str]:
    """Return type and size of a shape; MuJoCo has half lengths."""
    sizes = np.array(shape.sizes)
    sizes[0 if shape.kind == "box" else 1 :] *= 0.5
    return {"type": shape.kind, "size": texts(sizes)}


def rod(end: FloatArray) -> dict[str, str] | None:
    """Return a rod from a link's origin to `end` (3,) [m] in its frame; None if it would be too short."""
    if np.linalg.norm(end) < PartSettings.shortest_rod_m:
        return None
    size = texts(np.array([PartSettings.rod_radius_m]))
    return {"type": "capsule", "fromto": f"0 0 0 {texts(end)}", "size": size, "rgba": _GREY}


def placed(T: FloatArray) -> dict[str, str]:
    """Return the attributes of a pose (4, 4)."""
    x, y, z, w = quaternions(T[None, :3, :3])[0]
    return {"pos": texts(T[:3, 3]), "quat": texts(np.array([w, x, y, z]))}


def texts(values: FloatArray) -> str:
    return " ".join(map(repr, (np.atleast_1d(values) + 0.0).tolist()))  # no minus before a zero


@contextmanager
def _blamed_on(element: Any, urdf: Path) -> Iterator[None]:
    """Raise RobotError if an attribute in `element` is not a number."""
    try:
        yield
    except ValueError as error:
        what = f"{element.tag} {element.get('name')!r}: {error}"
        raise RobotError(what, file=urdf, line=element.sourceline, remedy="Give numbers") from None


def _inertia(inertial: Any) -> FloatArray:
    """Return the inertia tensor (3, 3) along the link's axes, corrected to be physically possible."""
    element = inertial.find("inertia")
    xx, yy, zz, xy, xz, yz = (float(element.get(key, "0")) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
    moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    origin, T = inertial.find("origin"), np.eye(4)
    if origin is not None:
        T[:3, :3] = rotation_of(_floats(origin.get("rpy", "0 0 0")))
        T[:3, 3] = _floats(origin.get("xyz", "0 0 0"))
    R = T[:3, :3] @ axes
    return R @ np.diag(np.maximum(moments, PartSettings.min_inertia_kgm2)) @ R.T


def _floats(text: str) -> FloatArray:
    return np.array([float(word) for word in text.split()])


def _readable(file: Path) -> bool:
    if file.suffix.lower() not in _MESHES:
        return False
    if file.suffix.lower() != ".stl":
        return True
    with file.open("rb") as stream:
        head = stream.read(STL_HEAD_BYTES)
    if len(head) < STL_HEAD_BYTES:
        return False
    (triangles,) = struct.unpack("<I", head[-4:])
    size = STL_HEAD_BYTES + STL_TRIANGLE.itemsize * triangles
    return 0 < triangles <= PartSettings.max_triangles and file.stat().st_size == size
