"""The calibration board: a flat board of known squares."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray

Pattern = Literal["charuco", "chessboard"]

MARKER_SHARE = 0.75
SIZES = (50, 100, 250, 1000)
_DICTIONARY = re.compile(r"(?:[4-7]X[4-7]_(?:50|100|250|1000)|ARUCO_ORIGINAL|APRILTAG_(?:16h5|25h9|36h10|36h11))")


class _Settings:
    max_columns = 24  # of another board that is tried
    # Allowed deviation of a marker's corners from a perspective image of a plane, due to lens distortion [sides].
    fitting_sides = 0.25


@dataclass(frozen=True)
class Board:
    """A chessboard, with an ArUco marker in each white square if the pattern is `charuco`.

    Board frame: origin at the outer corner of the upper left square, which is black; x to the right along the rows,
    y down, z into the board.

    Attributes:
        columns, rows: number of squares.
        square_m: side of a square [m].
        marker_m: side of a marker's black frame [m]; None: 0.75 of a square.
        dictionary: OpenCV name of the markers' dictionary without DICT_; None: the smallest of 4×4 bits.
        pattern: `charuco` or `chessboard`; a chessboard has no markers, so all of it must be in view.

    Raises:
        ConfigError: such a board is impossible.
    """

    columns: int = 8
    rows: int = 6
    square_m: float = 0.030
    marker_m: float | None = None
    dictionary: str | None = None
    pattern: Pattern = "charuco"

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 40 and 3 <= self.rows <= 40):
            raise ConfigError(f"a board of {self.columns}x{self.rows} squares", remedy="Take 3 to 40 squares each way")
        if not 0.001 <= self.square_m <= 1.0:
            raise ConfigError(f"squares of {1e3 * self.square_m:g} mm", remedy="Take 1 to 1000 mm")
        if self.marker_m is not None and not 0.3 * self.square_m <= self.marker_m <= 0.9 * self.square_m:
            raise ConfigError(
                f"markers of {1e3 * self.marker_m:g} mm in squares of {1e3 * self.square_m:g} mm",
                remedy="Take 0.3 to 0.9 of a square: corners need white around them",
            )
        if self.dictionary is not None and not _DICTIONARY.fullmatch(self.dictionary):
            raise ConfigError(
                f"there is no dictionary {self.dictionary!r}", remedy="Take one as in 4X4_50, 6X6_250, APRILTAG_36h11"
            )
        if self.pattern == "charuco" and len(self.marker_squares) > marker_count(self.dictionary_name):
            raise ConfigError(
                f"{len(self.marker_squares)} markers are needed, {self.dictionary_name} has "
                f"{marker_count(self.dictionary_name)}",
                remedy="Take fewer squares or a larger dictionary",
            )

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height over all squares [m]."""
        return self.columns * self.square_m, self.rows * self.square_m

    @property
    def marker_side_m(self) -> float:
        """Side of a marker's black frame [m]; 0 of a chessboard, which has none."""
        if self.pattern == "chessboard":
            return 0.0
        return MARKER_SHARE * self.square_m if self.marker_m is None else self.marker_m

    @property
    def dictionary_name(self) -> str:
        """OpenCV name of the dictionary, without DICT_."""
        if self.dictionary is not None:
            return self.dictionary
        needed = len(self.marker_squares)
        return f"4X4_{smallest_size(needed)}"

    @cached_property
    def marker_squares(self) -> list[tuple[int, int]]:
        """Column and row of the white squares, in the order of the marker numbers."""
        return [(c, r) for r in range(self.rows) for c in range(self.columns) if (c + r) % 2 == 1]

    @cached_property
    def corners_m(self) -> FloatArray:
        """Inner corners, where four squares meet, in the order of their numbers, shape (n, 3) [m], z = 0."""
        c, r = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return np.asarray(self.square_m * np.stack([c.ravel(), r.ravel(), np.zeros(c.size)], axis=1), dtype=np.float64)

    @property
    def name(self) -> str:
        """Description of the board, for messages."""
        squares = f"{self.columns}x{self.rows} squares of {1e3 * self.square_m:g} mm"
        return f"{squares}, {self.dictionary_name}" if self.pattern == "charuco" else f"{squares}, plain"

    def opencv(self) -> Any:
        """Return the board as an OpenCV object."""
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.marker_side_m, dictionary(self.dictionary_name)
        )


def smallest_size(markers: int) -> int:
    """Return the size of the smallest dictionary with enough markers, or of the largest if there is none."""
    return next((size for size in SIZES if size >= markers), SIZES[-1])


def dictionary(name: str) -> Any:
    """Return the OpenCV dictionary with that name, without DICT_."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def marker_count(name: str) -> int:
    """Return the number of markers in a dictionary."""
    return len(dictionary(name).bytesList)


def marker_bits(board: Board, number: int) -> FloatArray:
    """Return the cells of a marker with its black frame of one cell, shape (cells, cells), 1 white and 0 black."""
    cells = int(dictionary(board.dictionary_name).markerSize) + 2
    image = cv2.aruco.generateImageMarker(dictionary(board.dictionary_name), number, cells)
    return np.asarray(image > 127, dtype=np.float64)


def visible_squares(numbers: Sequence[int], corners_px: Sequence[FloatArray], board: Board) -> str | None:
    """Return None if the markers fit the board; otherwise the squares, such as 10x7, of the smallest board they fit.

    If they fit no board, return the squares of `board`.

    Args:
        numbers: marker numbers.
        corners_px: their corners, shape (4, 2) each, clockwise from the upper left.
    """
    seen = np.stack(corners_px)
    if (
        max(numbers) < len(board.marker_squares)
        and _fit_error(numbers, seen, board.columns, board) < _Settings.fitting_sides
    ):
        return None
    fits = {columns: _fit_error(numbers, seen, columns, board) for columns in range(3, _Settings.max_columns + 1)}
    columns = min(fits, key=lambda each: fits[each])
    if fits[columns] > _Settings.fitting_sides:
        return f"{board.columns}x{board.rows}"
    rows = max(_square_of(number, columns)[1] for number in numbers) + 1
    return f"{columns}x{max(rows, 3)}"


def _square_of(number: int, columns: int) -> tuple[int, int]:
    """Return column and row of a marker's square. Two neighbouring rows together have `columns` markers."""
    pair, rest = divmod(number, columns)
    upper = columns // 2
    return (2 * rest + 1, 2 * pair) if rest < upper else (2 * (rest - upper), 2 * pair + 1)


def _fit_error(numbers: Sequence[int], seen_px: FloatArray, columns: int, board: Board) -> float:
    """Return the median distance of the marker corners from the best perspective image of a board, in marker sides."""
    share = board.marker_side_m / board.square_m
    square = 0.5 + 0.5 * share * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    model = np.concatenate([np.array(_square_of(number, columns)) + square for number in numbers])
    flat = seen_px.reshape(-1, 2)
    H, _ = cv2.findHomography(model, flat, 0)
    if H is None:
        return np.inf
    mapped = cv2.perspectiveTransform(model[:, None], H)[:, 0]
    side = np.median(np.linalg.norm(seen_px - np.roll(seen_px, 1, axis=1), axis=2))
    return float(np.median(np.linalg.norm(mapped - flat, axis=1)) / side)
