"""The meshes that a URDF names, made ready for pybullet: valid, and with few triangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .mesh_file import LARGEST_MESH_BYTES, MESHES, MeshError, read_mesh, stl_bytes

# No link of an arm is larger; one of 10 mm is, if its mesh is in millimetres. No part that is drawn is as small.
LARGEST_M, SMALLEST_M = 10.0, 1e-6
# TinyRenderer takes 0.3 µs for a triangle, and a stereo frame is four pictures: 8,000 cost some 10 ms of CPU a frame.
MOST_TRIANGLES = 8_000
_MOST_BYTES = 4 * LARGEST_MESH_BYTES
_FIRST_CELL_M, _GROWTH = 0.001, 1.4
# A hull tells what is in the way. It is that of the outermost points in these directions (Fibonacci's sphere).
_TURNS, _HEIGHTS = np.pi * (1.0 + 5.0**0.5) * np.arange(100), np.linspace(-1.0, 1.0, 100)
_RADII = np.sqrt(1.0 - _HEIGHTS**2)
_DIRECTIONS = np.vstack(
    [np.column_stack([_RADII * np.cos(_TURNS), _RADII * np.sin(_TURNS), _HEIGHTS]), np.eye(3), -np.eye(3)]
)


class Meshes:
    """The meshes of one URDF. Ask for each with `add`, then take all of them with `files`.

    Attributes:
        missing: names of those that are not there.
        unusable: why others cannot be used, by name.
    """

    def __init__(self, urdf: Path) -> None:
        self._urdf = urdf
        self._bytes = 0
        self._read: dict[str, FloatArray | None] = {}
        self._sizes: dict[str, int] = {}
        self._shapes: dict[tuple[str, tuple[float, ...]], FloatArray] = {}
        self._drawn: list[tuple[str, tuple[float, ...]]] = []
        self.missing: list[str] = []
        self.unusable: dict[str, str] = {}

    def add(self, name: str, scale: tuple[float, ...], *, drawn: bool) -> str | None:
        """Return the name of the file that will show the mesh `name`, or its hull; None when it cannot be used.

        Args:
            scale: factors of x, y and z.
            drawn: as it looks; else its convex hull, which is what pybullet makes of any mesh that may be touched.
        """
        key = (name, scale)
        if key not in self._shapes:
            triangles = self._triangles(name)
            if triangles is None:
                return None
            with np.errstate(over="ignore"):
                scaled = triangles * np.array(scale)
            low, high = scaled.min(axis=(0, 1)), scaled.max(axis=(0, 1))
            size = float((high - low).max())
            if not SMALLEST_M <= size <= LARGEST_M or max(np.abs(low).max(), np.abs(high).max()) > LARGEST_M:
                self.unusable[name] = (
                    f"it is {size:.3g} m large, or lies too far from its link. A mesh in millimetres needs "
                    'scale="0.001 0.001 0.001"'
                )
                return None
            self._shapes[key] = scaled if np.prod(scale) > 0.0 else scaled[:, ::-1]
        if drawn:
            self._drawn.append(key)
        return f"{'drawn' if drawn else 'hull'}_{list(self._shapes).index(key)}.stl"

    def files(self) -> tuple[dict[str, bytes], str]:
        """Return the files by name, and in words how much coarser they are than the meshes, if they are."""
        drawn = {key: self._shapes[key] for key in self._drawn}
        before = sum(self._sizes[name] for name, _ in self._drawn)
        count, cell = self._count(drawn), 0.0
        while count > MOST_TRIANGLES:
            cell = max(_FIRST_CELL_M, _GROWTH * cell)
            drawn = {key: _merged(triangles, cell) for key, triangles in drawn.items()}
            count = self._count(drawn)
        files = {}
        for number, (key, triangles) in enumerate(self._shapes.items()):
            if len(drawn.get(key, ())):
                files[f"drawn_{number}.stl"] = stl_bytes(drawn[key])
            files[f"hull_{number}.stl"] = stl_bytes(_hull(triangles))
        coarser = f"the meshes have {before:,} triangles. To be quick, the simulation draws the robot with {count:,}"
        return files, coarser if count < before else ""

    def _count(self, drawn: dict[tuple[str, tuple[float, ...]], FloatArray]) -> int:
        return sum(len(drawn[key]) for key in self._drawn)

    def _triangles(self, name: str) -> FloatArray | None:
        if name not in self._read:
            self._read[name] = None
            file = self._found(name)
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
        if self._bytes > _MOST_BYTES:
            raise MeshError(f"the meshes are larger than {_MOST_BYTES >> 20} MiB together")
        triangles, cell = read_mesh(file), 0.0
        self._sizes[name] = len(triangles)
        size = float(np.ptp(triangles, axis=(0, 1)).max())
        while len(triangles) > MOST_TRIANGLES and size > 0.0:  # more will not be drawn of it
            cell = max(size / 1000.0, _GROWTH * cell)
            triangles = _merged(triangles, cell)
        if not len(triangles):
            raise MeshError("its triangles are too small for its size")
        return triangles

    def _found(self, name: str) -> Path | None:
        if name.startswith("package://"):
            inside = Path(name.removeprefix("package://"))
            folders = self._urdf.resolve().parents
            candidates = [folder / part for folder in folders for part in (inside, Path(*inside.parts[1:]))]
        else:
            candidates = [self._urdf.resolve().parent / name.removeprefix("file://")]
        return next((candidate for candidate in candidates if candidate.is_file()), None)


def _merged(triangles: FloatArray, cell: float) -> FloatArray:
    """Return triangles (n, 3, 3) with all corners in one cell [m] of a grid merged into one, without those that vanish.

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
    """Return the number of the cell of a grid that each of the points (n, 3) is in, shape (n,)."""
    cells = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    return (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]


def _hull(triangles: FloatArray) -> FloatArray:
    """Return about the convex hull of triangles as triangles (m, 3, 3); of what is flat its box, 1 mm thick."""
    from scipy.spatial import ConvexHull, QhullError  # only large meshes need it, and it takes half a second

    points = triangles.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    corners = points[np.unique((points @ _DIRECTIONS.T).argmax(axis=0))]
    try:
        return corners[ConvexHull(corners).simplices]
    except (QhullError, ValueError):
        high = np.maximum(high, low + 0.001)
        box = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        return box[ConvexHull(box).simplices]
