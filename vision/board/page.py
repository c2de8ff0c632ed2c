"""The board's page, in millimetres: black rectangles, and two rulers to check the print against."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from interfaces.errors import ConfigError

from .board import Board, marker_bits

PAPERS_MM = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "tabloid": (279.4, 431.8),
}
# Most printers leave about 5 mm of the sheet white.
_MARGIN_MM = 7.0
# What the rulers and the line of text need below and beside the board.
_RULER_MM = 14.0
_LINE_MM = 0.2
_TEXT_MM = 3.0


@dataclass(frozen=True)
class Rectangle:
    """A black rectangle; x to the right and y down from the sheet's upper left corner [mm]."""

    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float


@dataclass(frozen=True)
class Text:
    """A line of text that begins at x with its base line at y [mm]; `turned` runs upwards."""

    x_mm: float
    y_mm: float
    text: str
    turned: bool = False
    size_mm: float = _TEXT_MM


@dataclass(frozen=True)
class Page:
    """A sheet with what is black on it.

    Attributes:
        size_mm: width and height of the sheet.
        board_mm: where the board's upper left corner is.
        rulers_mm: lengths of the rulers, across and upright.
    """

    size_mm: tuple[float, float]
    board_mm: tuple[float, float]
    rulers_mm: tuple[float, float]
    rectangles: tuple[Rectangle, ...]
    texts: tuple[Text, ...]


def page(board: Board, paper: str = "A4") -> Page:
    """The board on a sheet, upright or across, whichever leaves more room.

    Raises:
        ConfigError: no such paper, or the board does not fit on it.
    """
    size = _sheet(board, paper)
    width, height = (1e3 * side for side in board.size_m)
    x = _MARGIN_MM + 0.5 * (size[0] - width - 2 * _MARGIN_MM - _RULER_MM)
    y = _MARGIN_MM + 0.5 * (size[1] - height - 2 * _MARGIN_MM - _RULER_MM)
    rulers = rulers_mm(board)
    below, beside = y + height + 0.35 * _RULER_MM, x + width + 0.35 * _RULER_MM
    lines = [*_ruler(x, below, rulers[0], upright=False), *_ruler(beside, y, rulers[1], upright=True)]
    texts = (
        Text(
            x,
            below + 7.0,
            f"{board.name}. Print at 100 %, then measure: this line is {rulers[0]:g} mm, the upright one "
            f"{rulers[1]:g} mm.",
        ),
        Text(beside + 7.0, y + rulers[1], f"{rulers[1]:g} mm", turned=True),
    )
    return Page(size, (x, y), rulers, (*_squares(board, x, y), *_markers(board, x, y), *lines), texts)


def rulers_mm(board: Board) -> tuple[float, float]:
    """Lengths of the rulers on a board's page, across and upright."""
    width, height = (_ruler_length(1e3 * side) for side in board.size_m)
    return width, height


def _sheet(board: Board, paper: str) -> tuple[float, float]:
    known = {name.lower(): size for name, size in PAPERS_MM.items()}
    if paper.lower() not in known:
        raise ConfigError(f"there is no paper {paper!r}", remedy=f"Take one of {', '.join(PAPERS_MM)}")
    short, long = known[paper.lower()]
    width, height = (1e3 * side for side in board.size_m)
    need = 2 * _MARGIN_MM + _RULER_MM
    sheets = [(long, short), (short, long)]
    fitting = [sheet for sheet in sheets if sheet[0] >= width + need and sheet[1] >= height + need]
    if not fitting:
        largest = max(min((w - need) / board.columns, (h - need) / board.rows) for w, h in sheets)
        raise ConfigError(
            f"{board.columns}x{board.rows} squares of {1e3 * board.square_m:g} mm with rulers do not fit on {paper}",
            remedy=f"There is room for squares of {math.floor(2 * largest) / 2:g} mm; or take larger paper",
        )
    return max(fitting, key=lambda sheet: min(sheet[0] - width, sheet[1] - height))


def _ruler_length(room_mm: float) -> float:
    """As long as the board has room for, in tens of millimetres; below that, in millimetres."""
    return 10.0 * math.floor(room_mm / 10.0 + 1e-9) or math.floor(room_mm)


def _squares(board: Board, x: float, y: float) -> list[Rectangle]:
    side = 1e3 * board.square_m
    return [
        Rectangle(x + c * side, y + r * side, side, side)
        for r in range(board.rows)
        for c in range(board.columns)
        if (c + r) % 2 == 0
    ]


def _markers(board: Board, x: float, y: float) -> list[Rectangle]:
    if board.pattern != "charuco":
        return []
    square, side = 1e3 * board.square_m, 1e3 * board.marker_side_m
    inset = 0.5 * (square - side)
    found = []
    for number, (c, r) in enumerate(board.marker_squares):
        bits = marker_bits(board, number)
        cell = side / len(bits)
        left, top = x + c * square + inset, y + r * square + inset
        found += [
            Rectangle(left + first * cell, top + row * cell, (last - first) * cell, cell)
            for row in range(len(bits))
            for first, last in _black_runs(bits[row].tolist())
        ]
    return found


def _black_runs(cells: list[float]) -> list[tuple[int, int]]:
    """Neighbouring black cells are one rectangle: viewers draw hairs between two."""
    edges = [
        k for k in range(len(cells) + 1) if (0 < k < len(cells) and cells[k] != cells[k - 1]) or k in (0, len(cells))
    ]
    return [(a, b) for a, b in pairwise(edges) if cells[a] == 0]


def _ruler(x: float, y: float, length: float, *, upright: bool) -> list[Rectangle]:
    """A line with a tick at each centimetre; the outer edges of its end ticks are `length` apart."""
    ticks = [min(max(10.0 * k - 0.5 * _LINE_MM, 0.0), length - _LINE_MM) for k in range(int(length / 10.0) + 1)]
    ticks[-1] = length - _LINE_MM
    if upright:
        line = Rectangle(x + 1.5, y, _LINE_MM, length)
        return [line, *(Rectangle(x, y + at, 3.0, _LINE_MM) for at in ticks)]
    return [Rectangle(x, y + 1.5, length, _LINE_MM), *(Rectangle(x + at, y, _LINE_MM, 3.0) for at in ticks)]
