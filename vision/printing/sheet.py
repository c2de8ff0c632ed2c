"""A sheet of paper, in millimetres: black rectangles, and two rulers to check the print."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray

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


class Layout:
    margin_mm = 7.0  # most printers leave about 5 mm of the sheet white
    ruler_mm = 14.0  # what the rulers and the line of text need below and beside the drawing
    around_mm = 2 * margin_mm + ruler_mm  # of the sheet's sides, what the drawing does not get
    line_mm = 0.2  # width of a thin line
    text_mm = 3.0  # height of the letters
    letter_width = 0.52  # Helvetica's letters are half as wide as high, on the mean


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
    size_mm: float = Layout.text_mm


@dataclass(frozen=True)
class Page:
    """A sheet with its black rectangles and texts."""

    size_mm: tuple[float, float]  # width and height of the sheet
    drawing_mm: tuple[float, float]  # position of the drawing's upper left corner
    rulers_mm: tuple[float, float]  # lengths of the rulers, across and upright
    rectangles: tuple[Rectangle, ...]
    texts: tuple[Text, ...]


def sheets(paper: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return a paper's (width, height) in landscape and in portrait [mm]; raise ConfigError for an unknown paper."""
    known = {name.lower(): size for name, size in PAPERS_MM.items()}
    if paper.lower() not in known:
        raise ConfigError(f"there is no paper {paper!r}", remedy=f"Take one of {', '.join(PAPERS_MM)}")
    short, long = known[paper.lower()]
    return (long, short), (short, long)


def page(
    size_mm: tuple[float, float], paper: str, name: str, rectangles: Sequence[Rectangle], texts: Sequence[Text] = ()
) -> Page | None:
    """Place a drawing with rulers on a sheet, portrait or landscape, whichever leaves more room; None if too large.

    Args:
        size_mm: width and height of the drawing.
        name: title, printed below the ruler.
        rectangles, texts: the drawing, from its upper left corner.

    Raises:
        ConfigError: the paper is unknown.
    """
    width, height = size_mm
    fitting = [
        each for each in sheets(paper) if each[0] >= width + Layout.around_mm and each[1] >= height + Layout.around_mm
    ]
    if not fitting:
        return None
    sheet = max(fitting, key=lambda each: min(each[0] - width, each[1] - height))
    x, y = (Layout.margin_mm + 0.5 * (side - own - Layout.around_mm) for side, own in zip(sheet, size_mm, strict=True))
    rulers = rulers_mm(size_mm)
    below_y, right_x = y + height + 0.35 * Layout.ruler_mm, x + width + 0.35 * Layout.ruler_mm
    lines = [*_ruler(x, below_y, rulers[0], upright=False), *_ruler(right_x, y, rulers[1], upright=True)]
    instruction = f"Print at 100 %, then measure: this line is {rulers[0]:g} mm, the upright one {rulers[1]:g} mm."
    words = [_line(caption, x, below_y + 7.0 + k * 4.0, sheet[0]) for k, caption in enumerate((instruction, name))]
    words.append(Text(right_x + 7.0, y + rulers[1], f"{rulers[1]:g} mm", turned=True))
    moved = [Rectangle(x + r.x_mm, y + r.y_mm, r.width_mm, r.height_mm) for r in rectangles]
    written = [replace(text, x_mm=x + text.x_mm, y_mm=y + text.y_mm) for text in texts]
    return Page(sheet, (x, y), rulers, (*moved, *lines), (*written, *words))


def _line(text: str, x: float, y: float, sheet_mm: float) -> Text:
    """Return a line of text that begins at x, or further left if it would leave the sheet."""
    longest = Layout.letter_width * Layout.text_mm * len(text)
    return Text(max(min(x, sheet_mm - Layout.margin_mm - longest), Layout.margin_mm), y, text)


def rulers_mm(size_mm: tuple[float, float]) -> tuple[float, float]:
    """Return the lengths of the horizontal and the vertical ruler [mm] beside a drawing of this size."""
    width, height = (_ruler_length(side) for side in size_mm)
    return width, height


def pattern(white: FloatArray, x_mm: float, y_mm: float, side_mm: float) -> list[Rectangle]:
    """Return the black cells of a square pattern (cells, cells), 1 white and 0 black, with upper left corner (x, y)."""
    cell = side_mm / len(white)
    return [
        Rectangle(x_mm + first * cell, y_mm + row * cell, (last - first) * cell, cell)
        for row, cells in enumerate(white.tolist())
        for first, last in _black_runs(cells)
    ]


def _ruler_length(room_mm: float) -> float:
    """Return the longest ruler that fits, in whole centimetres, or in whole millimetres below 1 cm [mm]."""
    return 10.0 * math.floor(room_mm / 10.0 + 1e-9) or math.floor(room_mm)


def _black_runs(cells: list[float]) -> list[tuple[int, int]]:
    """Return (first, end) of each run of black cells; one rectangle a run avoids hairlines between cells in viewers."""
    edges = [
        k for k in range(len(cells) + 1) if (0 < k < len(cells) and cells[k] != cells[k - 1]) or k in (0, len(cells))
    ]
    return [(a, b) for a, b in pairwise(edges) if cells[a] == 0]


def _ruler(x: float, y: float, length: float, *, upright: bool) -> list[Rectangle]:
    """Return a line with a tick at each centimetre; the outer edges of its end ticks are `length` apart."""
    ticks = [
        min(max(10.0 * k - 0.5 * Layout.line_mm, 0.0), length - Layout.line_mm) for k in range(int(length / 10.0) + 1)
    ]
    ticks[-1] = length - Layout.line_mm
    if upright:
        line = Rectangle(x + 1.5, y, Layout.line_mm, length)
        return [line, *(Rectangle(x, y + at, 3.0, Layout.line_mm) for at in ticks)]
    return [Rectangle(x, y + 1.5, length, Layout.line_mm), *(Rectangle(x + at, y, Layout.line_mm, 3.0) for at in ticks)]
