"""Detection of a board's corners in an image, with the reason if there are none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bodyschema.interfaces.records import FloatArray, ImageArray

from .board import SIZES, Board, dictionary, smallest_size, visible_squares
from .refine import refine_corners
from .sharpness import SharpnessSettings, blur_px, image_fault

IntArray = NDArray[np.int64]
FaultKind = Literal[
    "dark", "over_exposed", "blurred", "mirrored", "other_dictionary", "other_pattern", "other_squares", "not_found"
]
# Reasons that mean that another board is in view.
OTHER_BOARD: tuple[FaultKind, ...] = ("mirrored", "other_dictionary", "other_pattern", "other_squares")


class _Settings:
    min_corners = 6  # of a usable image
    min_markers = 3  # that show which board is in view
    smallest_grid = (4, 3)  # corners of an unknown chessboard: smaller ones are found in any texture


_FAMILIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "APRILTAG_36h11", "ARUCO_ORIGINAL")


@dataclass(frozen=True)
class Corners:
    """A board's corners in one image.

    Attributes:
        numbers: numbers of the corners found, shape (n,), increasing.
        px: image coordinates of the corners, shape (n, 2) [px].
        blur_px: 1-sigma of the edges' blur in the blurrier direction [px].
    """

    numbers: IntArray
    px: FloatArray
    blur_px: float = 0.0

    def __len__(self) -> int:
        return len(self.numbers)


@dataclass(frozen=True)
class NotFound:
    """Reason why an image shows no usable board.

    Attributes:
        why: the kind of reason.
        text: message with a remedy.
    """

    why: FaultKind
    text: str


class BoardDetector:
    """Detector of one board."""

    def __init__(self, board: Board) -> None:
        """Create OpenCV's detector for this board."""
        self.board = board
        self._charuco = None if board.pattern == "chessboard" else cv2.aruco.CharucoDetector(board.opencv())
        self._other_family: str | None = None

    def find(self, image: ImageArray) -> Corners | NotFound:
        """Find the board's corners in `image`, shape (height, width, 3) BGR or (height, width)."""
        grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        found = self._find_chessboard(grey) if self._charuco is None else self._find_charuco(grey)
        if isinstance(found, NotFound):
            fault = image_fault(grey)
            return found if fault is None else NotFound(*fault)
        blur = blur_px(grey, self.board, found.numbers, found.px)
        if blur > SharpnessSettings.max_blur_px:
            text = f"blurred: edges have a 1-sigma of {blur:.1f} px. Hold the board still, focus, shorten the exposure"
            return NotFound("blurred", text)
        return Corners(found.numbers, found.px, blur)

    def _find_charuco(self, grey: ImageArray) -> Corners | NotFound:
        px, numbers, marker_px, marker_numbers = self._charuco.detectBoard(grey)  # pyright: ignore
        markers = [] if marker_numbers is None else [int(number) for number in np.ravel(marker_numbers)]
        if len(markers) >= _Settings.min_markers:
            seen = visible_squares(
                markers, [np.reshape(each, (4, 2)).astype(np.float64) for each in marker_px], self.board
            )
            if seen is not None:
                expected = f"{self.board.columns}x{self.board.rows}"
                text = f"the board has {seen} squares, not {expected}. Give --squares {seen}, or take the right board"
                if seen == expected:
                    text = "the markers are not where this board has them: bent, or not made by this program"
                return self._mirrored(grey, len(markers)) or NotFound("other_squares", text)
        if numbers is None or len(numbers) < _Settings.min_corners:
            return self._reason_not_found(grey, len(markers))
        order = np.argsort(np.ravel(numbers))
        rough = np.ravel(numbers)[order].astype(np.int64), np.reshape(px, (-1, 2))[order].astype(np.float64)
        found = refine_corners(grey, self.board, *rough)
        return Corners(*found) if len(found[0]) >= _Settings.min_corners else self._reason_not_found(grey, len(markers))

    def _reason_not_found(self, grey: ImageArray, markers: int) -> NotFound:
        mirrored = self._mirrored(grey, markers)
        if mirrored is not None:
            return mirrored
        if markers:
            return NotFound("not_found", f"too little of the board: {markers} of its markers. Bring it into view")
        other = self._other_dictionary(grey, self.board.dictionary_name)
        if other is not None:
            expected = self.board.dictionary_name
            text = f"the markers are {other}, not {expected}. Give --dictionary {other}, or take the right board"
            return NotFound("other_dictionary", text)
        squares = _plain_squares(grey)
        if squares is not None:
            seen = "x".join(map(str, squares))
            text = f"a plain chessboard of {seen} squares. Give --pattern chessboard --squares {seen}"
            return NotFound("other_pattern", text)
        return NotFound("not_found", "no board. Bring it into view, larger, and not in glare")

    def _mirrored(self, grey: ImageArray, markers: int) -> NotFound | None:
        """Return the fault if a mirrored image has more markers; some markers look like others when mirrored."""
        mirrored = _markers(np.ascontiguousarray(grey[:, ::-1]), self.board.dictionary_name)
        if len(mirrored) < max(_Settings.min_markers, markers + 1):
            return None
        return NotFound("mirrored", "the board is mirrored: print it again as it is, or mirror the images back")

    def _find_chessboard(self, grey: ImageArray) -> Corners | NotFound:
        size = (self.board.columns - 1, self.board.rows - 1)
        found, px = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_ACCURACY)
        if not found:
            markers = self._other_dictionary(grey, None)
            if markers is not None:
                remedy = f"Leave out --pattern, and give --dictionary {markers}"
                return NotFound("other_pattern", f"the board has {markers} markers in its squares. {remedy}")
            # It takes five times as long as the first search.
            found, px = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)
        if not found:
            return self._reason_no_chessboard(grey)
        return measured_grid(grey, np.reshape(px, (size[1], size[0], 2)), self.board)

    def _reason_no_chessboard(self, grey: ImageArray) -> NotFound:
        expected = self.board.columns, self.board.rows
        name = "x".join(map(str, expected))
        squares = _plain_squares(grey)
        if squares is None:
            return NotFound("not_found", f"no chessboard of {name} squares. All of it has to be in view")
        seen = "x".join(map(str, squares))
        if squares[0] <= max(expected) and squares[1] <= min(expected):
            return NotFound("not_found", f"{seen} squares of a chessboard, not {name}. All of it has to be in view")
        text = f"the board has {seen} squares, not {name}. Give --squares {seen}, or take the right board"
        return NotFound("other_squares", text)

    def _other_dictionary(self, grey: ImageArray, expected: str | None) -> str | None:
        """Return the family of other markers in the image, if there are any.

        The search among a thousand words of each family takes seconds, so it comes last.
        """
        bits = "" if expected is None else expected.split("_")[0]
        families = [name for name in _FAMILIES if name.split("_")[0] != bits or "APRILTAG" in name]
        for names in self._candidate_families(grey, families):
            seen = {name: _markers(grey, name) for name in names if name != expected}
            best = max(seen, key=lambda name: len(seen[name]), default="")
            if best and len(seen[best]) >= _Settings.min_markers:
                self._other_family = best
                bits, _, size = best.partition("_")
                return f"{bits}_{smallest_size(max(seen[best]) + 1)}" if size == str(SIZES[-1]) else best
        return None

    def _candidate_families(self, grey: ImageArray, families: Sequence[str]) -> Iterator[list[str]]:
        """Yield families to search for: an earlier image's, then those whose first words are visible, then all."""
        if self._other_family is not None:
            yield [self._other_family]
        largest, smallest = f"_{SIZES[-1]}", f"_{SIZES[0]}"
        sized = [name for name in families if name.endswith(largest)]
        yield [name for name in sized if len(_markers(grey, name.replace(largest, smallest))) >= _Settings.min_markers]
        yield list(families)


def _markers(grey: ImageArray, family: str) -> list[int]:
    """Return the numbers of the markers of a family."""
    detector: Any = cv2.aruco.ArucoDetector(dictionary(family))
    numbers: Sequence[int] | None = detector.detectMarkers(grey)[1]
    return [] if numbers is None else np.ravel(numbers).tolist()


def _plain_squares(grey: ImageArray) -> tuple[int, int] | None:
    """Return the larger and the smaller number of squares of the chessboard in an image, or of its visible part."""
    grid = any_grid(grey)
    if grid is None:
        return None
    return len(grid[0]) + 1, len(grid) + 1


def any_grid(grey: ImageArray) -> FloatArray | None:
    """Return the corners (rows, columns, 2) [px] of the visible part of a chessboard, with more columns than rows."""
    found, px, grid = cv2.findChessboardCornersSBWithMeta(grey, _Settings.smallest_grid, cv2.CALIB_CB_LARGER)
    if not found:
        return None
    corners = np.reshape(np.asarray(px, dtype=np.float64), (*np.shape(grid)[:2], 2))
    return corners if len(corners) <= len(corners[0]) else corners.transpose(1, 0, 2)


def measured_grid(grey: ImageArray, rough_px: ArrayLike, board: Board) -> Corners:
    """Return all corners of a plain chessboard in order, from rough ones (rows, columns, 2) [px].

    They are refined if they then lie better on a plane: truncated outer squares disturb some.
    """
    ordered = _ordered(grey, np.asarray(rough_px, dtype=np.float64), board).reshape(-1, 2)
    numbers = np.arange(len(ordered))
    kept, px = refine_corners(grey, board, numbers, ordered)
    if len(kept) < len(numbers) or _scatter(board, px) > _scatter(board, ordered):
        px = ordered
    return Corners(numbers, px)


def _scatter(board: Board, px: FloatArray) -> float:
    """Return the sum of the squared distances [px²] of all corners from a plane's image."""
    return float(np.square(px - on_plane(board, px)).sum())


def on_plane(board: Board, px: FloatArray) -> FloatArray:
    """Return the image of a plane (n, 2) [px] that best fits all corners of a board."""
    places = board.corners_m[:, :2] / board.square_m
    H, _ = cv2.findHomography(places, px, 0)
    return np.asarray(cv2.perspectiveTransform(places[:, None], H)[:, 0], dtype=np.float64)


def _ordered(grey: ImageArray, grid: FloatArray, board: Board) -> FloatArray:
    """Return the corners (rows, columns, 2), rotated so that the square up and left of the first one is black.

    If the pattern is ambiguous, the first corner is the one nearer to the image's upper left.
    """
    a, b = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if a[0] * b[1] - a[1] * b[0] < 0:  # a mirrored order
        grid = grid[:, ::-1]
    if (board.columns + board.rows) % 2 == 0:
        return grid if grid[0, 0].sum() <= grid[-1, -1].sum() else grid[::-1, ::-1]
    inner = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    pixels = np.clip(np.rint(inner).astype(int), 0, np.array(grey.shape)[::-1] - 1)
    levels = grey[pixels[..., 1], pixels[..., 0]].astype(np.float64)
    dark = np.add.outer(np.arange(levels.shape[0]), np.arange(levels.shape[1])) % 2 == 0
    return grid if levels[dark].mean() < levels[~dark].mean() else grid[::-1, ::-1]
