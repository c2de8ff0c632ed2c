"""The meshes that a URDF names, made ready for pybullet: valid, and with few triangles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.mesh_file import stl_bytes
from bodyschema.robot.meshes import MeshSet

# TinyRenderer takes 0.3 µs for a triangle, and a stereo frame is four pictures: 8,000 cost some 10 ms of CPU a frame.
MOST_TRIANGLES = 8_000
# A hull tells what is in the way. It is that of the outermost points in these directions (Fibonacci's sphere).
_TURNS, _HEIGHTS = np.pi * (1.0 + 5.0**0.5) * np.arange(100), np.linspace(-1.0, 1.0, 100)
_RADII = np.sqrt(1.0 - _HEIGHTS**2)
_DIRECTIONS = np.vstack(
    [np.column_stack([_RADII * np.cos(_TURNS), _RADII * np.sin(_TURNS), _HEIGHTS]), np.eye(3), -np.eye(3)]
)


class Meshes(MeshSet):
    """The meshes of one URDF as files. Ask for each with `add`, then take all of them with `files`."""

    def __init__(self, urdf: Path) -> None:
        super().__init__(urdf, MOST_TRIANGLES)
        self._drawn: list[int] = []

    def add(self, name: str, scale: tuple[float, ...], *, drawn: bool) -> str | None:
        """Return the name of the file that will show the mesh `name`, or its hull; None when it cannot be used.

        Args:
            scale: factors of x, y and z.
            drawn: as it looks; else its convex hull, which is what pybullet makes of any mesh that may be touched.
        """
        number = self.number_of(name, scale)
        if number is None:
            return None
        if drawn:
            self._drawn.append(number)
        return f"{'drawn' if drawn else 'hull'}_{number}.stl"

    def files(self) -> tuple[dict[str, bytes], str]:
        """Return the files by name, and in words how much coarser they are than the meshes, if they are."""
        drawn, before = self.coarser(self._drawn)
        files = {}
        for number, triangles in enumerate(self.shapes):
            if len(drawn.get(number, ())):
                files[f"drawn_{number}.stl"] = stl_bytes(drawn[number])
            files[f"hull_{number}.stl"] = stl_bytes(_hull(triangles))
        count = sum(len(drawn[number]) for number in self._drawn)
        coarser = f"the meshes have {before:,} triangles. To be quick, the simulation draws the robot with {count:,}"
        return files, coarser if count < before else ""


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
