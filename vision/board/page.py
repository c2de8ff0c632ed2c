"""Printable page of the calibration board."""

from __future__ import annotations

import math

from bodyschema.interfaces.errors import ConfigError
from bodyschema.vision.printing.sheet import Layout, Page, Rectangle, pattern, sheets
from bodyschema.vision.printing.sheet import page as drawn_page

from .board import Board, marker_bits


def page(board: Board, paper: str = "A4") -> Page:
    """Lay out the board on a sheet, in portrait or landscape, whichever leaves more room.

    Raises:
        ConfigError: the paper is unknown, or the board does not fit on it.
    """
    width, height = (1e3 * side for side in board.size_m)
    drawing = drawn_page((width, height), paper, board.name, [*_squares(board), *_markers(board)])
    if drawing is None:
        around = Layout.around_mm
        largest = max(min((w - around) / board.columns, (h - around) / board.rows) for w, h in sheets(paper))
        raise ConfigError(
            f"{board.columns}x{board.rows} squares of {1e3 * board.square_m:g} mm with rulers do not fit on {paper}",
            remedy=f"There is room for squares of {math.floor(2 * largest) / 2:g} mm; or take larger paper",
        )
    return drawing


def _squares(board: Board) -> list[Rectangle]:
    side = 1e3 * board.square_m
    return [
        Rectangle(c * side, r * side, side, side)
        for r in range(board.rows)
        for c in range(board.columns)
        if (c + r) % 2 == 0
    ]


def _markers(board: Board) -> list[Rectangle]:
    if board.pattern != "charuco":
        return []
    square, side = 1e3 * board.square_m, 1e3 * board.marker_side_m
    inset = 0.5 * (square - side)
    return [
        black
        for number, (c, r) in enumerate(board.marker_squares)
        for black in pattern(marker_bits(board, number), c * square + inset, r * square + inset, side)
    ]
