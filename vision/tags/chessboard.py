"""Detection of a plain chessboard as one large tag: its inner corners, with their covariance."""

from __future__ import annotations

import logging

import cv2
import numpy as np

from bodyschema.interfaces.records import FloatArray, ImageArray, Reason
from bodyschema.vision.board.board import Board
from bodyschema.vision.board.detector import any_grid, measured_grid, on_plane
from bodyschema.vision.image_checks import is_black, too_white

from .config import ChessboardConfig
from .finder import Region, Seen
from .image import TagImage
from .settings import EdgeSettings, TagSettings

_log = logging.getLogger(__name__)
_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE + cv2.CALIB_CB_FAST_CHECK


class ChessboardFinder:
    """Detector of a chessboard, all of which has to be in view. It is number 0 of its body."""

    def __init__(self, shape: ChessboardConfig) -> None:
        self._board = Board(shape.columns, shape.rows, shape.square_m, pattern="chessboard")
        self._warned = False

    def suspicion(self, grey: ImageArray) -> Reason | None:
        """Return the fault of the whole image's light, if there is one."""
        if is_black(grey):
            return Reason.LOW_CONTRAST
        return Reason.SATURATED if too_white(grey) is not None else None

    def find(self, grey: ImageArray, region: Region | None = None) -> Seen:
        """Find the board in a region (left, top, right, bottom) of a grey image; a refused board has its reason."""
        x0, y0, x1, y1 = region or (0, 0, grey.shape[1], grey.shape[0])
        part, size = np.ascontiguousarray(grey[y0:y1, x0:x1]), (self._board.columns - 1, self._board.rows - 1)
        found, px = cv2.findChessboardCorners(part, size, flags=_FLAGS)
        if found:
            seen = self._measured(part, np.reshape(np.asarray(px, np.float64), (size[1], size[0], 2)))
        else:
            seen = self._partly(part) if part.shape == grey.shape else None
        if isinstance(seen, TagImage):
            self._warned = False
            seen = TagImage(0, seen.corners_px + np.array([x0, y0]), seen.cov_px)
        return {} if seen is None else {0: seen}

    def _partly(self, grey: ImageArray) -> TagImage | Reason | None:
        """Return the board if only a slower search finds it, or the reason if another or a part is in view."""
        grid = any_grid(grey)
        if grid is None:
            return None
        expected = sorted((self._board.rows - 1, self._board.columns - 1))
        if list(grid.shape[:2]) == expected:
            return self._measured(grey, grid if self._board.columns > self._board.rows else grid.transpose(1, 0, 2))
        if grid.shape[0] <= expected[0] and grid.shape[1] <= expected[1]:
            return Reason.OCCLUDED
        return self._other(f"{grid.shape[1] + 1}x{grid.shape[0] + 1}")

    def _other(self, squares: str) -> Reason:
        if not self._warned:
            self._warned = True
            expected = f"{self._board.columns}x{self._board.rows}"
            _log.warning("a chessboard of %s squares is in view, not one of %s", squares, expected)
        return Reason.REPROJECTION

    def _measured(self, grey: ImageArray, rough_px: FloatArray) -> TagImage | Reason:
        """Return the board from rough corners (rows, columns, 2) [px].

        Its plane, bent a little, leaves residuals at the corners. Their scatter is the corners' 1-sigma.
        """
        px = measured_grid(grey, rough_px, self._board).px
        if (reason := self._squares_fault(grey, px)) is not None:
            return reason
        variance = self._variance(px)
        grid = px.reshape(self._board.rows - 1, self._board.columns - 1, 2)
        side_px = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).mean()) for axis in (0, 1))
        if variance > (TagSettings.max_corner_sigma * side_px) ** 2:
            return Reason.NOT_STRAIGHT
        return TagImage(0, px, variance * np.eye(px.size))

    def _variance(self, px: FloatArray) -> float:
        """Return the corners' variance [px²] about the image of a plane that is bent along x, y, or twisted."""
        x, y = (self._board.corners_m[:, :2] / self._board.square_m).T
        flat = on_plane(self._board, px)
        bent = np.kron(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1), np.eye(2))
        tilted = np.stack([x, y], axis=1)[:, None] * flat[..., None]
        free, residuals = np.column_stack([bent, tilted.reshape(-1, 2)]), (px - flat).ravel()
        change, _, rank, _ = np.linalg.lstsq(free, residuals)
        return float(np.square(residuals - free @ change).sum()) / (residuals.size - int(rank))

    def _squares_fault(self, grey: ImageArray, px: FloatArray) -> Reason | None:
        """Return the fault of the squares' levels: too little contrast, or more squares beyond the border."""
        columns, rows = np.meshgrid(np.arange(-1, self._board.columns + 1), np.arange(-1, self._board.rows + 1))
        middles = np.stack([columns, rows], axis=-1) + 0.5
        H, _ = cv2.findHomography(self._board.corners_m[:, :2] / self._board.square_m, px, 0)
        at = cv2.perspectiveTransform(middles.reshape(-1, 1, 2), H).reshape(middles.shape).astype(np.float32)
        seen = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        levels = np.asarray(seen, np.float64)
        dark = (columns + rows) % 2 == 0
        inner = np.s_[1:-1, 1:-1]
        contrast = levels[inner][~dark[inner]].mean() - levels[inner][dark[inner]].mean()
        if contrast < EdgeSettings.min_contrast:
            return Reason.LOW_CONTRAST
        # A margin has 0 of the contrast, another row of squares all of it: 0.3 to 0.85 change no outcome of the tests.
        for side in (np.s_[0, 1:-1], np.s_[-1, 1:-1], np.s_[1:-1, 0], np.s_[1:-1, -1]):
            if levels[side][~dark[side]].min() - levels[side][dark[side]].max() > 0.5 * contrast:
                return self._other("more")
        return None
