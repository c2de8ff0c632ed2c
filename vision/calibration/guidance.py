"""Coverage of the views so far, and advice on the next view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from bodyschema.vision.board import Board, Corners
from bodyschema.vision.rig.lens import Lens

from .initial_estimate import pose_of
from .settings import ViewSettings as _Settings
from .view import EYES, Eye, View, all_px, image_of, seen_by

_ROWS, _COLUMNS = ("upper", "middle", "lower"), ("left", "middle", "right")
GRID = (len(_ROWS), len(_COLUMNS))


@dataclass(frozen=True)
class Coverage:
    """Coverage of the image, of tilts and of distances by the views."""

    whole_views: int  # number of views seen by all eyes
    cells: NDArray[np.int64]  # corners in each cell of a 3×3 grid, for each eye, shape (eyes, 3, 3)
    # rough tilt of the board in each whole view about the image's vertical and horizontal axes, shape (n, 2); right
    # edge away and lower edge away are positive
    tilts_deg: FloatArray
    extents: FloatArray  # extent of the board in each whole view, as a share of the image
    eyes: tuple[Eye, ...] = EYES  # the eyes in use

    @classmethod
    def of(
        cls, views: Sequence[View], board: Board, image_size_px: tuple[int, int], eyes: tuple[Eye, ...] = EYES
    ) -> Coverage:
        """Return the coverage of these views."""
        whole = [view for view in views if view.is_seen_by(eyes)]
        left = seen_by(whole, "left")
        tilts = [rough_tilt_deg(corners, board, image_size_px) for corners in left]
        extents = [extent(corners, image_size_px) for corners in left]
        cells = np.array([cell_counts(all_px(views, eye), image_size_px) for eye in eyes])
        return cls(len(whole), cells, np.reshape(tilts, (-1, 2)), np.array(extents), eyes)

    def covered(self, eye: Eye) -> NDArray[np.bool_]:
        """Return the cells of an eye's image that have enough corners, shape (3, 3)."""
        return self.cells[self.eyes.index(eye)] >= _Settings.corners_a_cell

    @property
    def largest_tilts_deg(self) -> FloatArray:
        """Total tilt of each whole view [deg], shape (n,)."""
        return np.hypot(self.tilts_deg[:, 0], self.tilts_deg[:, 1])

    def missing(self) -> list[str]:
        """Return advice on the next views, the most useful first; empty if nothing is missing."""
        return [*self._tilts_missing(), *self._cells_missing(), *self._distances_missing(), *self._views_missing()]

    @property
    def progress(self) -> float:
        """Fraction of the wanted coverage reached, 0 to 1."""
        wanted = len(self.tilted()) + len(self.eyes) * GRID[0] * GRID[1] + 2 + _Settings.wanted_views
        missing_count = len(self._tilts_missing()) + len(self._cells_missing()) + len(self._distances_missing())
        return 1.0 - (missing_count + max(_Settings.wanted_views - self.whole_views, 0)) / wanted

    def tilted(self) -> dict[str, int]:
        """Return the number of views in which each edge of the board is farther away than the opposite one."""
        about_upright, about_level = self.tilts_deg[:, 0], self.tilts_deg[:, 1]
        tilted_by_edge = {
            "right": about_upright > _Settings.tilt_deg,
            "left": about_upright < -_Settings.tilt_deg,
            "lower": about_level > _Settings.tilt_deg,
            "upper": about_level < -_Settings.tilt_deg,
        }
        return {edge: int(np.count_nonzero(tilted)) for edge, tilted in tilted_by_edge.items()}

    @property
    def has_near(self) -> bool:
        """True if a view shows the board near."""
        return bool(np.any(self.extents > _Settings.near))

    @property
    def has_far(self) -> bool:
        """True if a view shows the board far away."""
        return bool(np.any(self.extents < _Settings.far))

    def _tilts_missing(self) -> list[str]:
        return [
            f"tilt the board's {edge} edge away from the camera{'s' * (len(self.eyes) > 1)}, by 30°"
            for edge, count in self.tilted().items()
            if count < _Settings.tilted_each_way
        ]

    def _cells_missing(self) -> list[str]:
        return [
            f"bring the board to the {cell_name(r, c)} of the {image_of(eye, self.eyes)}"
            for eye in self.eyes
            for r, c in np.argwhere(~self.covered(eye)).tolist()
        ]

    def _distances_missing(self) -> list[str]:
        texts = []
        if not self.has_near:
            texts.append("bring the board nearer, until it fills more than half of the image")
        if not self.has_far:
            texts.append("take the board further away, until it fills a third of the image")
        return texts

    def _views_missing(self) -> list[str]:
        missing_count = _Settings.wanted_views - self.whole_views
        return (
            [f"{missing_count} more view{'s' if missing_count > 1 else ''}, tilted and anywhere"]
            if missing_count > 0
            else []
        )


def cell_name(row: int, column: int) -> str:
    """Return the name of a grid cell, such as "upper left"."""
    return "middle" if (row, column) == (1, 1) else f"{_ROWS[row]} {_COLUMNS[column]}"


def cell_counts(px: FloatArray, image_size_px: tuple[int, int]) -> NDArray[np.int64]:
    """Count the image points (n, 2) in each cell of the grid, rows first."""
    rows = np.clip(px[:, 1] / image_size_px[1] * GRID[0], 0, GRID[0] - 1).astype(int)
    columns = np.clip(px[:, 0] / image_size_px[0] * GRID[1], 0, GRID[1] - 1).astype(int)
    counts = np.zeros(GRID, dtype=np.int64)
    np.add.at(counts, (rows, columns), 1)
    return counts


def extent(corners: Corners, image_size_px: tuple[int, int]) -> float:
    """Return the share of the image that the corners span: the larger of both directions."""
    return float(np.max(np.ptp(corners.px, axis=0) / np.array(image_size_px)))


def rough_tilt_deg(corners: Corners, board: Board, image_size_px: tuple[int, int]) -> tuple[float, float]:
    """Return the board's tilt out of the image plane, as in `Coverage`.

    The image plane is the reference, not the plane perpendicular to the line of sight: a board parallel to the image
    plane shows no perspective anywhere in the image, and does not determine the focal length.
    """
    width, height = image_size_px
    focal = _Settings.usual_focal * width
    lens = Lens("pinhole", (focal, focal), (0.5 * (width - 1), 0.5 * (height - 1)), (0.0,) * 5)
    normal = cv2.Rodrigues(pose_of(corners, board.corners_m, lens)[:3])[0][:, 2]
    right, lower = np.degrees(np.arcsin(-normal[:2] * np.sign(normal[2]))).tolist()
    return right, lower
