"""Number of squares of the board in an image, from the marker numbers, which run row by row."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from bodyschema.interfaces.records import FloatArray

from .board import Board

_MOST = 24
# of a marker's side: allowed deviation of its corners from a perspective image of a plane, for lens distortion
_FITTING = 0.25


def squares_seen(numbers: Sequence[int], corners_px: Sequence[FloatArray], board: Board) -> str | None:
    """Return None if the markers fit the board; else the squares, such as 10x7, of the smallest board they fit.

    If they fit no board, return the squares of `board`.

    Args:
        numbers: marker numbers.
        corners_px: their corners, shape (4, 2) each, clockwise from the upper left.
    """
    seen = np.stack(corners_px)
    if max(numbers) < len(board.marker_squares) and _misfit(numbers, seen, board.columns, board) < _FITTING:
        return None
    fits = {columns: _misfit(numbers, seen, columns, board) for columns in range(3, _MOST + 1)}
    columns = min(fits, key=lambda each: fits[each])
    if fits[columns] > _FITTING:
        return f"{board.columns}x{board.rows}"
    rows = max(_place(number, columns)[1] for number in numbers) + 1
    return f"{columns}x{max(rows, 3)}"


def _place(number: int, columns: int) -> tuple[int, int]:
    """Return column and row of a marker's square. Two rows have as many markers as one has squares."""
    pair, rest = divmod(number, columns)
    upper = columns // 2
    return (2 * rest + 1, 2 * pair) if rest < upper else (2 * (rest - upper), 2 * pair + 1)


def _misfit(numbers: Sequence[int], seen_px: FloatArray, columns: int, board: Board) -> float:
    """Return the median distance of the marker corners from the best perspective image of a board, in marker sides."""
    share = board.marker_side_m / board.square_m
    square = 0.5 + 0.5 * share * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    model = np.concatenate([np.array(_place(number, columns)) + square for number in numbers])
    flat = seen_px.reshape(-1, 2)
    H, _ = cv2.findHomography(model, flat, 0)
    if H is None:
        return np.inf
    mapped = cv2.perspectiveTransform(model[:, None], H)[:, 0]
    side = np.median(np.linalg.norm(seen_px - np.roll(seen_px, 1, axis=1), axis=2))
    return float(np.median(np.linalg.norm(mapped - flat, axis=1)) / side)
