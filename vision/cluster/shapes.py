"""Bodies folded from a sheet with a tag on each face: positions of the faces on the sheet and on the body."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.tags.config import PlacedTag

Cell = tuple[int, int]
# Column and row of a face's neighbour on the sheet, and the axis of its frame (x right, y up) that they fold about:
# a positive angle folds away from who looks at the print.
_STEPS: dict[Cell, tuple[FloatArray, FloatArray]] = {
    (1, 0): (np.array([0.5, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])),
    (-1, 0): (np.array([-0.5, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])),
    (0, -1): (np.array([0.0, 0.5, 0.0]), np.array([-1.0, 0.0, 0.0])),
    (0, 1): (np.array([0.0, -0.5, 0.0]), np.array([1.0, 0.0, 0.0])),
}


@dataclass(frozen=True)
class Face:
    """A face with its tag."""

    cell: Cell  # column and row on the sheet, from its upper left
    rotation: FloatArray  # (3, 3), from the face's frame (x right, y up, z out of the print) to the body's
    centre: FloatArray  # (3,) in the body's frame [faces' widths]


@dataclass(frozen=True)
class Shape:
    """Faces of one size that are connected on the sheet."""

    name: str  # description
    faces: tuple[Face, ...]  # in the order of their tags: row by row

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the shape on the sheet."""
        return 1 + max(face.cell[0] for face in self.faces), 1 + max(face.cell[1] for face in self.faces)

    @property
    def folds(self) -> list[tuple[Cell, Cell]]:
        """Pairs of cells between which the sheet is folded."""
        turns = {face.cell: face.rotation for face in self.faces}
        pairs = [(cell, (cell[0] + c, cell[1] + r)) for cell in turns for c, r in ((1, 0), (0, 1))]
        return [(cell, other) for cell, other in pairs if other in turns and not np.allclose(turns[cell], turns[other])]

    @property
    def cuts(self) -> list[tuple[Cell, Cell]]:
        """Pairs of a face's cell and the free cell beside it, between which the sheet is cut."""
        cells = {face.cell for face in self.faces}
        neighbours = [(cell, (cell[0] + c, cell[1] + r)) for cell in sorted(cells) for c, r in _STEPS]
        return [(cell, other) for cell, other in neighbours if other not in cells]

    def placed(self, ids: Sequence[int], width_m: float) -> tuple[PlacedTag, ...]:
        """Return the poses on the body of the tags with these numbers, for faces of this width [m].

        Raises:
            ConfigError: the number of ids differs from that of the faces.
        """
        if len(ids) != len(self.faces):
            raise ConfigError(f"{self.name} has {len(self.faces)} tags, not {len(ids)}", remedy="Give as many --ids")
        return tuple(
            PlacedTag(id=id, xyz=_vector(width_m * face.centre), rpy=rpy_of(face.rotation))
            for id, face in zip(ids, self.faces, strict=True)
        )


def cube() -> Shape:
    """Return a cube; its frame is at its centre, oriented as the tag in the middle of the unfolded cross."""
    links = [((1, 1), cell) for cell in ((0, 1), (2, 1), (1, 0), (1, 2))] + [((2, 1), (3, 1))]
    return _folded("a cube", Face((1, 1), np.eye(3), np.array([0.0, 0.0, 0.5])), [(*link, 90.0) for link in links])


def plate(columns: int, rows: int, fold_deg: float) -> Shape:
    """Return a plate with each column folded away from the previous one; its frame is that of the first tag.

    With folds of 0° it is flat; four columns folded by 90° each are the sides of a box.

    Raises:
        ConfigError: there are no tags, or the columns would intersect.
    """
    if columns < 1 or rows < 1:
        raise ConfigError(f"a plate of {columns}x{rows} tags", remedy="Take one and more each way")
    if abs(fold_deg) > 120.0 or abs(fold_deg) * columns > 360.0 + 1e-9:
        raise ConfigError(
            f"{columns} columns folded by {fold_deg:g}° each run into each other", remedy="Fold by less, or take fewer"
        )
    links = [((c, 0), (c + 1, 0), fold_deg) for c in range(columns - 1)]
    links += [((c, r), (c, r + 1), 0.0) for r in range(rows - 1) for c in range(columns)]
    return _folded(f"a plate of {columns}x{rows} tags", Face((0, 0), np.eye(3), np.zeros(3)), links)


def chessboard(columns: int, rows: int) -> Shape:
    """Return the white squares of a board whose upper left square is black; its frame is that of the first tag."""
    cells = [(c, r) for r in range(rows) for c in range(columns) if (c + r) % 2 == 1]
    centres = [np.array([c - 1.0, -r, 0.0]) for c, r in cells]
    faces = tuple(Face(cell, np.eye(3), centre) for cell, centre in zip(cells, centres, strict=True))
    return Shape(f"a board of {columns}x{rows} squares", faces)


def _folded(name: str, first: Face, links: Sequence[tuple[Cell, Cell, float]]) -> Shape:
    """Build a shape from its first face and the fold angles [deg] of links, each from a known face to a neighbour."""
    faces = {first.cell: first}
    for known, cell, degrees in links:
        parent = faces[known]
        to_edge, axis = _STEPS[cell[0] - known[0], cell[1] - known[1]]
        rotation = parent.rotation @ Rotation.from_rotvec(math.radians(degrees) * axis).as_matrix()
        faces[cell] = Face(cell, rotation, parent.centre + parent.rotation @ to_edge + rotation @ to_edge)
    ordered = sorted(faces.values(), key=lambda face: (face.cell[1], face.cell[0]))
    return Shape(name, tuple(ordered))


def rpy_of(rotation: FloatArray) -> tuple[float, float, float]:
    """Return roll, pitch and yaw [rad] of a rotation (3, 3), URDF convention."""
    with warnings.catch_warnings():
        # At a pitch of 90° roll and yaw rotate about one axis: any split is right.
        warnings.filterwarnings("ignore", "Gimbal lock", UserWarning)
        return _vector(Rotation.from_matrix(rotation).as_euler("xyz"))


def _vector(values: FloatArray) -> tuple[float, float, float]:
    # Rounded to a nanometre, to avoid 6e-17 in files that people read.
    x, y, z = (float(value) + 0.0 for value in np.round(values, 9))
    return x, y, z
