"""Meshes that a URDF names: found, read, scaled, and made as coarse as their use needs."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .mesh_file import LARGEST_MESH_BYTES, MESHES, MeshError, read_mesh

# No link of an arm is larger; one of 10 mm is, if its mesh is in millimetres. No part that is drawn is as small.
LARGEST_M, SMALLEST_M = 10.0, 1e-6
_MOST_BYTES = 4 * LARGEST_MESH_BYTES
_FIRST_CELL_M, _GROWTH = 0.001, 1.4


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
    """Scaled meshes of one URDF, each under a number.

    Attributes:
        missing: names of those that are not there.
        unusable: why others cannot be used, by name.
    """

    def __init__(self, urdf: Path, most_triangles: int) -> None:
        """Initialise without meshes; all of them together will be drawn with at most `most_triangles`."""
        self._urdf, self._most = urdf, most_triangles
        self._bytes = 0
        self._read: dict[str, FloatArray | None] = {}
        self._sizes: dict[str, int] = {}
        self._numbers: dict[tuple[str, tuple[float, ...]], int] = {}
        self._names: list[str] = []
        self.shapes: list[FloatArray] = []
        self.missing: list[str] = []
        self.unusable: dict[str, str] = {}

    def number_of(self, name: str, scale: tuple[float, ...]) -> int | None:
        """Return the number of the mesh `name` with factors of x, y and z; None when it cannot be used."""
        key = (name, scale)
        if key not in self._numbers:
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
            self._numbers[key] = len(self.shapes)
            self._names.append(name)
            self.shapes.append(scaled if np.prod(scale) > 0.0 else scaled[:, ::-1])
        return self._numbers[key]

    def coarser(self, numbers: list[int]) -> tuple[dict[int, FloatArray], int]:
        """Return triangles (n, 3, 3) by number, few enough together, and how many the files have.

        Args:
            numbers: of the meshes to draw; one that is drawn twice counts twice.
        """
        drawn, cell = {number: self.shapes[number] for number in numbers}, 0.0
        while sum(len(drawn[number]) for number in numbers) > self._most:
            cell = max(_FIRST_CELL_M, _GROWTH * cell)
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
        if self._bytes > _MOST_BYTES:
            raise MeshError(f"the meshes are larger than {_MOST_BYTES >> 20} MiB together")
        triangles, cell = read_mesh(file), 0.0
        self._sizes[name] = len(triangles)
        size = float(np.ptp(triangles, axis=(0, 1)).max())
        while len(triangles) > self._most and size > 0.0:  # more will not be drawn of it
            cell = max(size / 1000.0, _GROWTH * cell)
            triangles = merged(triangles, cell)
        if not len(triangles):
            raise MeshError("its triangles are too small for its size")
        return triangles


def merged(triangles: FloatArray, cell: float) -> FloatArray:
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
