"""Meshes of a URDF: found, read from untrusted bytes, scaled, and simplified.

STL, OBJ and COLLADA are read as triangles. pybullet ends its process on a malformed file, so it only gets triangles
that were read here.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps.rotations import exponentials

from .limited import read_at_most

MESHES = (".stl", ".obj", ".dae")


class MeshLimits:
    mesh_bytes = 64 * 2**20  # the meshes of public arms have 0.1 to 20 MB
    triangles = 1_000_000  # 50 MB of a binary STL
    obj_line = 2**16
    nodes = 10_000  # COLLADA may place a node within itself
    # No link of an arm is larger; one of 10 mm is, if its mesh is in millimetres. No part that is drawn is as small.
    largest_m, smallest_m = 10.0, 1e-6
    all_bytes = 4 * mesh_bytes
    first_cell_m, cell_growth = 0.001, 1.4


STL_HEAD_BYTES = 84
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


def find_mesh(name: str, urdf: Path) -> Path | None:
    """Return the file of a mesh: relative to the URDF, or in a package whose folder is above the URDF or beside it."""
    if name.startswith("package://"):
        inside = Path(name.removeprefix("package://"))
        folders = urdf.resolve().parents
        candidates = [folder / part for folder in folders for part in (inside, Path(*inside.parts[1:]))]
    else:
        candidates = [urdf.resolve().parent / name.removeprefix("file://")]
    # Path.is_file raises OSError for names that are too long or not readable.
    return next((candidate for candidate in candidates if os.path.isfile(candidate)), None)


class MeshSet:
    """Scaled meshes of one URDF, each under a number."""

    def __init__(self, urdf: Path, most_triangles: int) -> None:
        """Initialise without meshes; all of them together will be drawn with at most `most_triangles`."""
        self._urdf, self._most = urdf, most_triangles
        self._bytes = 0
        self._read: dict[str, FloatArray | None] = {}
        self._sizes: dict[str, int] = {}
        self._numbers: dict[tuple[str, tuple[float, ...]], int] = {}
        self._names: list[str] = []
        self.shapes: list[FloatArray] = []
        self.missing: list[str] = []  # names of missing meshes
        self.unusable: dict[str, str] = {}  # reasons why others cannot be used, by name

    def number_of(self, name: str, scale: tuple[float, ...]) -> int | None:
        """Return the number of the mesh `name` with scale factors of x, y and z; None if it cannot be used."""
        key = (name, scale)
        if key not in self._numbers:
            triangles = self._triangles(name)
            if triangles is None:
                return None
            with np.errstate(over="ignore"):
                scaled = triangles * np.array(scale)
            low, high = scaled.min(axis=(0, 1)), scaled.max(axis=(0, 1))
            size = float((high - low).max())
            largest_m, farthest_m = MeshLimits.largest_m, max(np.abs(low).max(), np.abs(high).max())
            if not MeshLimits.smallest_m <= size <= largest_m or farthest_m > largest_m:
                self.unusable[name] = (
                    f"it is {size:.3g} m large, or lies too far from its link. A mesh in millimetres needs "
                    'scale="0.001 0.001 0.001"'
                )
                return None
            self._numbers[key] = len(self.shapes)
            self._names.append(name)
            self.shapes.append(scaled if np.prod(scale) > 0.0 else scaled[:, ::-1])
        return self._numbers[key]

    def coarser(self, numbers: list[int]) -> tuple[dict[int, FloatArray], int]:
        """Return triangles (n, 3, 3) by number, few enough together, and the number of triangles in the files.

        Args:
            numbers: meshes to draw; one that is drawn twice counts twice.
        """
        drawn, cell = {number: self.shapes[number] for number in numbers}, 0.0
        while sum(len(drawn[number]) for number in numbers) > self._most:
            cell = max(MeshLimits.first_cell_m, MeshLimits.cell_growth * cell)
            drawn = {number: merged(triangles, cell) for number, triangles in drawn.items()}
        return drawn, sum(self._sizes[self._names[number]] for number in numbers)

    def _triangles(self, name: str) -> FloatArray | None:
        if name not in self._read:
            self._read[name] = None
            file = find_mesh(name, self._urdf)
            if file is None:
                self.missing.append(name or "one without a file name")
                return None
            try:
                self._read[name] = self._triangles_of(file, name)
            except MeshError as error:
                self.unusable[name] = str(error)
        return self._read[name]

    def _triangles_of(self, file: Path, name: str) -> FloatArray:
        if file.resolve().suffix.lower() not in MESHES or file.suffix.lower() not in MESHES:
            raise MeshError(f"meshes end in {', '.join(MESHES)}")
        self._bytes += file.stat().st_size
        if self._bytes > MeshLimits.all_bytes:
            raise MeshError(f"the meshes are larger than {MeshLimits.all_bytes >> 20} MiB together")
        triangles, cell = read_mesh(file), 0.0
        self._sizes[name] = len(triangles)
        size = float(np.ptp(triangles, axis=(0, 1)).max())
        while len(triangles) > self._most and size > 0.0:  # no more of it will be drawn
            cell = max(size / 1000.0, MeshLimits.cell_growth * cell)
            triangles = merged(triangles, cell)
        if not len(triangles):
            raise MeshError("its triangles are too small for its size")
        return triangles


def merged(triangles: FloatArray, cell: float) -> FloatArray:
    """Merge all corners of triangles (n, 3, 3) in one cell [m] of a grid, and remove the triangles that vanish.

    Rossignac & Borrel 1993, Multi-resolution 3D approximations for rendering complex scenes.
    """
    if not len(triangles):
        return triangles
    points = triangles.reshape(-1, 3)
    _, place, count = np.unique(_keys(points, cell), return_inverse=True, return_counts=True)
    middles = np.column_stack([np.bincount(place, axis) for axis in points.T]) / count[:, None]
    corners = place.reshape(-1, 3)
    first, second, third = np.sort(corners, axis=1).T
    whole = np.flatnonzero((first != second) & (second != third))
    alike = (first * len(count) + second)[whole] * len(count) + third[whole]
    return middles[corners[whole[np.unique(alike, return_index=True)[1]]]]


def _keys(points: FloatArray, cell: float) -> np.ndarray:
    """Return the number of the grid cell that contains each of the points (n, 3), shape (n,)."""
    cells = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    return (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]


class MeshError(Exception):
    """A mesh file cannot be used; the message says why, without the file's name."""


def read_mesh(file: Path) -> FloatArray:
    """Return the triangles (n, 3, 3) of a mesh file, n at least 1, in metres if the file states its unit.

    Raises:
        MeshError: it cannot be read, is malformed or empty, or has numbers that are not finite.
    """
    try:
        data = read_at_most(file, MeshLimits.mesh_bytes)
    except OSError as error:
        raise MeshError(f"it cannot be read: {error.strerror}") from error
    read = {".stl": _stl, ".obj": _obj, ".dae": _collada}[file.suffix.lower()]
    try:
        with np.errstate(all="ignore"):
            triangles = read(data)
    except (ValueError, IndexError, OverflowError) as error:
        raise MeshError(f"it is malformed: {str(error)[:100]}") from error
    if not len(triangles):
        raise MeshError("it has no triangles")
    if len(triangles) > MeshLimits.triangles:
        raise MeshError(f"it has more than {MeshLimits.triangles:,} triangles")
    if not np.isfinite(triangles).all():
        raise MeshError("it has vertices that are not finite")
    return triangles


def stl_bytes(triangles: FloatArray) -> bytes:
    """Return triangles (n, 3, 3) as a binary STL file."""
    rows = np.zeros(len(triangles), dtype=STL_TRIANGLE)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    rows["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    rows["corners"] = triangles
    return bytes(STL_HEAD_BYTES - 4) + len(rows).to_bytes(4, "little") + rows.tobytes()


def _stl(data: bytes) -> FloatArray:
    announced = int.from_bytes(data[STL_HEAD_BYTES - 4 : STL_HEAD_BYTES], "little")
    there = (len(data) - STL_HEAD_BYTES) // STL_TRIANGLE.itemsize
    if len(data) >= STL_HEAD_BYTES and there >= announced and not _is_text(data):
        rows = np.frombuffer(data, dtype=STL_TRIANGLE, count=announced, offset=STL_HEAD_BYTES)
        return rows["corners"].astype(np.float64)
    if not _is_text(data):
        raise ValueError(f"{announced} triangles are announced, {max(there, 0)} are there")
    vertices = np.array(_STL_VERTEX.findall(data), dtype="S32").astype(np.float64)
    if len(vertices) % 3:
        raise ValueError("it ends within a triangle")
    return vertices.reshape(-1, 3, 3)


def _is_text(data: bytes) -> bool:
    """Return True for an ASCII STL; binary ones may begin with `solid`, too, but have NUL bytes."""
    return data.lstrip()[:5].lower() == b"solid" and b"\0" not in data[:1024]


def _obj(data: bytes) -> FloatArray:
    vertices: list[list[float]] = []
    corners: list[tuple[int, int, int]] = []
    for line in io.BytesIO(data):
        most = MeshLimits.triangles
        if len(line) > MeshLimits.obj_line or len(vertices) > 3 * most or len(corners) > most:
            raise ValueError("it is too long")
        kind, *values = line.split() or [b""]
        if kind not in (b"v", b"f"):
            continue
        if kind == b"v":
            x, y, z = (float(value) for value in values[:3])
            vertices.append([x, y, z])
            continue
        face = [_obj_index(value, len(vertices)) for value in values]
        corners += ((face[0], face[k], face[k + 1]) for k in range(1, len(face) - 1))
    if not corners:
        return np.zeros((0, 3, 3))
    return _picked(np.array(vertices, dtype=np.float64).reshape(-1, 3), np.array(corners))


def _obj_index(word: bytes, count: int) -> int:
    """Return the index of a face's corner `v`, `v/vt` or `v/vt/vn`, counted from 1, or back from the last vertex."""
    number = int(word.partition(b"/")[0])
    if number == 0:
        raise ValueError("a face names the vertex 0; they count from 1")
    return number - 1 if number > 0 else count + number


def _picked(vertices: FloatArray, corners: np.ndarray) -> FloatArray:
    """Return the triangles whose corners (n, 3) are given as indices of vertices."""
    if corners.min() < 0 or corners.max() >= len(vertices):
        raise ValueError("a face names a vertex that is not there")
    return vertices[corners]


def _collada(data: bytes) -> FloatArray:
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        raise ValueError(f"not XML: {error.msg}") from error
    return _Collada(root).triangles()


class _Collada:
    """The geometry of a COLLADA document, placed by its scene.

    Like ROS, it applies the document's unit and ignores its up axis.
    """

    def __init__(self, root: Any) -> None:
        self._root = root
        self._by_id = {element.get("id"): element for element in root.iter("{*}*") if element.get("id")}
        self._read: dict[Any, FloatArray] = {}
        self._nodes = self._count = 0

    def triangles(self) -> FloatArray:
        """Return all triangles (n, 3, 3) [m]."""
        unit = self._root.find("{*}asset/{*}unit")
        metres = 1.0 if unit is None else float(unit.get("meter", "1"))
        shown = self._root.find("{*}scene/{*}instance_visual_scene")
        scene = self._named(shown.get("url")) if shown is not None else self._root.find(".//{*}visual_scene")
        if scene is None:
            return np.zeros((0, 3, 3))
        parts = [part for node in scene.findall("{*}node") for part in self._node(node, np.eye(4))]
        return metres * np.concatenate([np.zeros((0, 3, 3)), *parts])

    def _named(self, url: str | None) -> Any:
        if url is None or url[:1] != "#" or url[1:] not in self._by_id:
            raise ValueError(f"it names {str(url)[:40]!r}, which is not there")
        return self._by_id[url[1:]]

    def _node(self, node: Any, T: FloatArray) -> Iterator[FloatArray]:
        todo = [(node, T)]
        while todo:
            node, T = todo.pop()
            self._nodes += 1
            if self._nodes > MeshLimits.nodes:
                raise ValueError(f"its scene has more than {MeshLimits.nodes} nodes")
            for element in node.iterchildren("{*}matrix", "{*}translate", "{*}rotate", "{*}scale"):
                T = T @ _placement(element)
            for instance in node.iterchildren("{*}instance_geometry"):
                triangles = self._once(self._geometry, self._named(instance.get("url")))
                self._count += len(triangles)
                if self._count > MeshLimits.triangles:
                    raise ValueError(f"it has more than {MeshLimits.triangles:,} triangles")
                yield triangles @ T[:3, :3].T + T[:3, 3]
            todo += [(child, T) for child in node.iterchildren("{*}node")]
            todo += [(self._named(child.get("url")), T) for child in node.iterchildren("{*}instance_node")]

    def _geometry(self, geometry: Any) -> FloatArray:
        faces = geometry.iterfind("{*}mesh/*")
        parts = [self._faces(element) for element in faces if element.tag.rpartition("}")[2] in _FACES]
        return np.concatenate([np.zeros((0, 3, 3)), *parts])

    def _once(self, read: Callable[[Any], FloatArray], element: Any) -> FloatArray:
        """Return `read(element)`, computed once: a file may refer to an element thousands of times."""
        if element not in self._read:
            self._read[element] = read(element)
        return self._read[element]

    def _faces(self, element: Any) -> FloatArray:
        """Return the triangles of one <triangles>, <polylist> or <polygons>; polygons as fans."""
        inputs = element.findall("{*}input")
        width = 1 + max((int(item.get("offset", "0")) for item in inputs), default=0)
        vertex = next((item for item in inputs if item.get("semantic") == "VERTEX"), None)
        if vertex is None:
            raise ValueError("faces without vertices")
        offset = int(vertex.get("offset", "0"))
        lists = [_numbers(p.text, np.int64)[offset::width] for p in element.findall("{*}p")]
        if element.tag.endswith("polygons"):
            sizes, corners = (
                np.array([len(places) for places in lists], dtype=np.int64),
                np.concatenate([_NONE, *lists]),
            )
        else:
            corners = np.concatenate([_NONE, *lists])
            counts = element.find("{*}vcount")
            sizes = np.full(len(corners) // 3, 3) if counts is None else _numbers(counts.text, np.int64)
        if len(sizes) and (sizes.min() < 3 or sizes.max() > len(corners) or sizes.sum() > len(corners)):
            raise ValueError("faces have fewer corners than are announced")
        if not len(sizes):
            return np.zeros((0, 3, 3))
        return _picked(self._positions(vertex), corners[_fans(sizes)])

    def _positions(self, vertex: Any) -> FloatArray:
        vertices = self._named(vertex.get("source"))
        position = next((item for item in vertices.findall("{*}input") if item.get("semantic") == "POSITION"), None)
        source = vertices if position is None else self._named(position.get("source"))
        values, accessor = source.find("{*}float_array"), source.find("{*}technique_common/{*}accessor")
        if values is None:
            raise ValueError("vertices without positions")
        numbers = self._once(lambda values: _numbers(values.text, np.float64), values)
        stride = 3 if accessor is None else int(accessor.get("stride", "3"))
        if stride < 3:
            raise ValueError(f"vertices of {stride} coordinates")
        return numbers[: len(numbers) // stride * stride].reshape(-1, stride)[:, :3]


_FACES = frozenset({"triangles", "polylist", "polygons"})
_NONE = np.zeros(0, dtype=np.int64)


def _fans(sizes: np.ndarray) -> np.ndarray:
    """Return the indices of the triangles' corners, for polygons given by their corner counts, one after another."""
    first = np.repeat(np.cumsum(sizes) - sizes, sizes - 2)
    begin = np.cumsum(sizes - 2) - (sizes - 2)
    step = np.arange(len(first)) - np.repeat(begin, sizes - 2)
    return np.column_stack([first, first + step + 1, first + step + 2])


def _numbers(text: str | None, kind: Any) -> np.ndarray:
    return np.array((text or "").split(), dtype=kind)


def _placement(element: Any) -> FloatArray:
    """Return one of a node's transforms, (4, 4)."""
    numbers, T = _numbers(element.text, np.float64), np.eye(4)
    match element.tag.rpartition("}")[2]:
        case "matrix":
            return numbers.reshape(4, 4)
        case "translate":
            T[:3, 3] = numbers.reshape(3)
            return T
        case "rotate":
            x, y, z, degrees = numbers
            length = float(np.hypot(np.hypot(x, y), z))
            turn = np.radians(degrees) * np.array([[x, y, z]]) / (length or 1.0)
            T[:3, :3] = exponentials(turn)[0][0]
            return T
        case _:
            return np.diag([*numbers.reshape(3), 1.0])
