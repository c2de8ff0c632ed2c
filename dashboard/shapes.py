"""Shapes of the robot's links for the page, read from the files of the URDF.

A child process reads them: mesh files may be large or malformed, and the page must neither wait for them nor grow.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Self

import msgspec
import numpy as np

from bodyschema.interfaces.errors import BodyschemaError, RobotError
from bodyschema.interfaces.interpreter import module_command
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.waits import NICENESS
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.limited import bounded_memory
from bodyschema.robot.meshes import MeshSet
from bodyschema.robot.shapes import Shape, link_shapes
from bodyschema.robot.suggest import first_few
from bodyschema.robot.urdf import MOVING, parse_urdf
from kbmaps.rotations import quaternions

from .documents import BodyDocument, CameraShape, LinkShape

log = logging.getLogger(__name__)

MODULE = "bodyschema.dashboard.shapes"


class _Settings:
    max_triangles: int = 30_000  # a triangle takes at most 60 bytes, so all meshes together at most 1.8 MB
    # Reading 256 MiB of text meshes takes minutes; the page is drawn without them meanwhile.
    read_limit_s: float = 180.0
    max_memory_bytes: int = 2**31  # of the process that reads meshes
    # Edges that are sharper than this stay sharp; a cylinder of 12 sides looks round.
    crease_cosine = float(np.cos(np.radians(32.0)))
    max_neighbours: int = 24  # corners at one vertex whose normals are compared, so that no mesh takes long


class LinkShapes(msgspec.Struct, frozen=True):
    """Result of the child process."""

    shapes: dict[str, list[LinkShape]] = {}  # of each link, by its name
    meshes: list[bytes] = []  # as `mesh_buffer` returns them
    said: list[str] = []  # differences from the URDF, in sentences


class Body:
    """The robot's appearance, read when the first browser asks; reading ends with the with statement."""

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._lock, self._starting = threading.Lock(), threading.Lock()
        self._found: LinkShapes | None = None
        self._child: subprocess.Popen[bytes] | None = None
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._starting:
            self._closed = True
            if self._child is not None:
                self._child.kill()

    def document(self) -> BodyDocument:
        """Return links, shapes and cameras."""
        found, tree = self._shapes(), self._robot.tree
        number = {link: k for k, link in enumerate(tree.links)}
        joints = tree.joints.values()
        return BodyDocument(
            links=list(tree.links),
            shapes=[found.shapes.get(link, []) for link in tree.links],
            rods=[
                (number[joint.parent], number[joint.child]) for joint in joints if not found.shapes.get(joint.parent)
            ],
            moving=[number[joint.child] for joint in joints if joint.kind in MOVING],
            camera=_camera(self._robot),
            said=found.said,
        )

    def mesh(self, number: int) -> bytes | None:
        """Return a mesh of the document; None if the number is unknown."""
        meshes = self._shapes().meshes
        return meshes[number] if 0 <= number < len(meshes) else None

    def _shapes(self) -> LinkShapes:
        with self._lock:
            if self._found is None:
                self._found = self._read(self._robot.tree.file)
            return self._found

    def _read(self, urdf: Path) -> LinkShapes:
        try:
            shapes = link_shapes(parse_urdf(urdf))
        except RobotError as error:  # it was there when the page began
            return LinkShapes(said=[f"{error}. Links are shown as rods."])
        if not any(shape.mesh for parts in shapes.values() for shape in parts):
            return _encoded(shapes, {}, [])
        try:
            return msgspec.msgpack.decode(self._run(module_command(MODULE, str(urdf))), type=LinkShapes)
        except (OSError, subprocess.SubprocessError, msgspec.DecodeError) as error:
            log.warning("the meshes of %s: %s", urdf, error)
            return _encoded(shapes, {}, ["The meshes that the URDF names could not be read. Links are shown as rods."])

    def _run(self, command: list[str]) -> bytes:
        """Return a child's output; SubprocessError if it fails, takes too long, or the page ends."""
        with self._starting:
            if self._closed:
                raise subprocess.SubprocessError("the page ends")
            self._child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)
        with self._child as child:
            try:
                output, _ = child.communicate(timeout=_Settings.read_limit_s)
            finally:
                child.kill()
        if child.returncode != 0:
            raise subprocess.CalledProcessError(child.returncode, command)
        return output


def read_shapes(urdf: Path) -> LinkShapes:
    """Return the visual shapes of all links of a URDF, and their meshes with few triangles.

    Raises:
        RobotError: the URDF cannot be read.
    """
    meshes, shapes = MeshSet(urdf, _Settings.max_triangles), link_shapes(parse_urdf(urdf))
    named = [(shape.mesh, shape.sizes) for parts in shapes.values() for shape in parts if shape.kind == "mesh"]
    used = [number for each in named if (number := meshes.number_of(*each)) is not None]
    visible, before = meshes.coarser(used)
    after = sum(len(visible[number]) for number in used)
    there = {each: visible[number] for each in named if (number := meshes.number_of(*each)) is not None}
    return _encoded(shapes, there, list(_sentences(meshes, before, after)))


def _encoded(
    shapes: dict[str, list[Shape]], meshes: dict[tuple[str, tuple[float, ...]], FloatArray], said: list[str]
) -> LinkShapes:
    """Return shapes without those whose mesh is missing, or has no triangles left, as screws may."""
    buffers = {key: mesh_buffer(triangles) for key, triangles in meshes.items() if len(triangles)}
    place = {key: number for number, key in enumerate(buffers)}
    found = {
        link: [
            LinkShape(
                each.kind,
                list(each.sizes),
                [*each.T_link_shape[:3, 3].tolist(), *quaternions(each.T_link_shape[None, :3, :3])[0].tolist()],
                None if each.rgba is None else list(each.rgba),
                place.get((each.mesh, each.sizes)),
            )
            for each in parts
            if each.kind != "mesh" or (each.mesh, each.sizes) in place
        ]
        for link, parts in shapes.items()
    }
    return LinkShapes(found, list(buffers.values()), said)


def _sentences(meshes: MeshSet, before: int, after: int) -> Iterator[str]:
    if meshes.missing:
        yield f"Missing meshes: {first_few(meshes.missing, '; ')}. Links without any are shown as rods."
    if faults := [f"{name}: {why}" for name, why in meshes.unusable.items()]:
        yield f"Meshes that cannot be used: {first_few(faults, '; ')}."
    if after < before:
        yield f"The meshes have {before:,} triangles, of which the page shows {after:,}."


def mesh_buffer(triangles: FloatArray) -> bytes:
    """Return triangles (n, 3, 3) [m] as a little-endian buffer that a browser passes to its graphics unchanged.

    The counts of vertices v and of indices i (uint32 each), positions (v, 3) float32, normals (v, 4) int8 of which the
    last is 0, and i indices uint32. Smooth surfaces share vertices.
    """
    points, vertex = np.unique(triangles.reshape(-1, 3).astype("<f4"), axis=0, return_inverse=True)
    vertex = vertex.reshape(-1)
    normals = _corner_normals(triangles, vertex)
    whole = np.round(127.0 * normals).astype(np.int8)
    keys = np.column_stack([vertex, whole.astype(np.int64) + 128]) @ np.array([1 << 24, 1 << 16, 1 << 8, 1])
    _, first, indices = np.unique(keys, return_index=True, return_inverse=True)
    counts = np.array([len(first), len(indices)], dtype="<u4")
    padded = np.zeros((len(first), 4), dtype=np.int8)
    padded[:, :3] = whole[first]
    return b"".join(
        part.tobytes() for part in (counts, points[vertex[first]], padded, indices.reshape(-1).astype("<u4"))
    )


def _corner_normals(triangles: FloatArray, vertex: np.ndarray) -> FloatArray:
    """Return the normal (3n, 3) of each corner: the mean over the faces at its vertex that have a similar normal.

    Args:
        triangles: (n, 3, 3).
        vertex: (3n,) number of each corner's vertex.
    """
    areas = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    faces = _unit(areas)
    order = np.argsort(vertex, kind="stable")
    vertices, face = vertex[order], order // 3
    sums = areas[face]
    for step in range(1, min(_Settings.max_neighbours, len(order))):
        here, there = face[:-step], face[step:]
        smooth = np.einsum("ij,ij->i", faces[here], faces[there]) > _Settings.crease_cosine
        alike = np.flatnonzero((vertices[:-step] == vertices[step:]) & smooth)
        sums[alike] += areas[there[alike]]
        sums[alike + step] += areas[here[alike]]
    normals = np.empty_like(sums)
    normals[order] = _unit(sums)
    return normals


def _unit(vectors: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.0)


def _camera(robot: RobotDescription) -> CameraShape | None:
    """Return the cameras' field of view at a distance of 1 m; None if robot.toml does not describe the cameras."""
    eyes = robot.calibration
    if eyes is None:
        return None
    sides = np.array(eyes.image_size_px)[:, None] * [0.0, 1.0] - 0.5
    edges = (sides - np.array(eyes.principal_point_px)[:, None]) / eyes.focal_px
    return CameraShape(eyes.eyes_m.tolist(), edges.ravel().tolist())


def main() -> None:
    """Write the shapes of the URDF named by the argument to standard output."""
    os.nice(NICENESS)
    try:
        with bounded_memory(_Settings.max_memory_bytes):
            found = read_shapes(Path(sys.argv[1]))
    except BodyschemaError as error:
        sys.exit(str(error))
    sys.stdout.buffer.write(msgspec.msgpack.encode(found))


if __name__ == "__main__":
    main()
