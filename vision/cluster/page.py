"""The page of tags: with lines to cut along, and lines to fold along if they form one body."""

from __future__ import annotations

import math
from collections.abc import Sequence

from bodyschema.interfaces.errors import ConfigError
from bodyschema.vision.printing.sheet import Layout, Page, Rectangle, Text, page, pattern, sheets
from bodyschema.vision.tags.config import Dictionary
from bodyschema.vision.tags.dictionary import tag_modules
from bodyschema.vision.tags.edge import MODULES

from .shapes import Cell, Shape

# Width of a tag's face in sides of the tag: a white margin of one module all around, and a little for cutting.
FACE_SIDES = 1.0 + 2.5 / MODULES


class _Settings:
    dash_mm = 2.0  # of the lines to fold along, and the gap between two
    gap_mm = 6.0  # between single tags, with room for their numbers


def shape_page(shape: Shape, ids: Sequence[int], dictionary: Dictionary, side_mm: float, paper: str) -> Page:
    """Lay out a shape to cut out and fold, with tags of these numbers row by row.

    Raises:
        ConfigError: the number of ids differs from that of the faces, a tag or the paper is unknown, or the shape does
            not fit.
    """
    width = FACE_SIDES * side_mm
    placed = shape.placed(ids, 1e-3 * width)
    black = [
        each
        for tag, face in zip(placed, shape.faces, strict=True)
        for each in _tag(dictionary, tag.id, face.cell[0] * width, face.cell[1] * width, side_mm)
    ]
    black += [line for cell, other in shape.cuts for line in _between(cell, other, width, dashed=False)]
    black += [line for cell, other in shape.folds for line in _between(cell, other, width, dashed=True)]
    columns, rows = shape.size
    name = f"{shape.name[0].upper()}{shape.name[1:]}, {dictionary} {_listed(ids)}, black squares of {side_mm:g} mm"
    drawing = page((columns * width, rows * width), paper, name, black)
    if drawing is None:
        around = Layout.around_mm
        room = max(min((w - around) / columns, (h - around) / rows) for w, h in sheets(paper)) / FACE_SIDES
        raise _too_large(f"{shape.name} with tags of {side_mm:g} mm", paper, room)
    return drawing


def tags_page(ids: Sequence[int], dictionary: Dictionary, side_mm: float, paper: str) -> Page:
    """Lay out single tags to cut apart, each with its number below.

    Raises:
        ConfigError: a tag or the paper is unknown, or the tags do not fit.
    """
    width = FACE_SIDES * side_mm
    pitch = width + _Settings.gap_mm
    _, (room, _) = sheets(paper)
    columns = min(len(ids), math.floor((room - Layout.around_mm + _Settings.gap_mm) / pitch))
    if columns < 1:
        raise _too_large(f"a tag of {side_mm:g} mm", paper, (room - Layout.around_mm) / FACE_SIDES)
    black: list[Rectangle] = []
    numbers: list[Text] = []
    for place, id in enumerate(ids):
        row, column = divmod(place, columns)
        x, y = column * pitch, row * pitch
        black += [*_tag(dictionary, id, x, y, side_mm), *_outline(x, y, width)]
        numbers.append(Text(x, y + width + Layout.text_mm + 0.5, f"{dictionary} {id}, {side_mm:g} mm"))
    rows = math.ceil(len(ids) / columns)
    name = f"{dictionary} {_listed(ids)}, black squares of {side_mm:g} mm"
    drawing = page((columns * pitch - _Settings.gap_mm, rows * pitch), paper, name, black, numbers)
    if drawing is None:
        raise ConfigError(f"{len(ids)} tags of {side_mm:g} mm do not fit on {paper}", remedy="Print them on two pages")
    return drawing


def _too_large(what: str, paper: str, room_mm: float) -> ConfigError:
    return ConfigError(
        f"{what} does not fit on {paper}",
        remedy=f"There is room for tags of {math.floor(room_mm):g} mm; or take larger paper",
    )


def _tag(dictionary: Dictionary, id: int, x: float, y: float, side: float) -> list[Rectangle]:
    inset = 0.5 * (FACE_SIDES - 1.0) * side
    return pattern(tag_modules(dictionary, id), x + inset, y + inset, side)


def _outline(x: float, y: float, width: float) -> list[Rectangle]:
    long = width + Layout.line_mm
    near, far = -0.5 * Layout.line_mm, width - 0.5 * Layout.line_mm
    level = [Rectangle(x + near, y + at, long, Layout.line_mm) for at in (near, far)]
    return [*level, *(Rectangle(x + at, y + near, Layout.line_mm, long) for at in (near, far))]


def _between(cell: Cell, other: Cell, width: float, *, dashed: bool) -> list[Rectangle]:
    """Return the line between two neighbouring cells, centred on their common edge."""
    column, row = max(cell[0], other[0]), max(cell[1], other[1])
    x, y = column * width, row * width
    dash = _Settings.dash_mm
    count = math.floor(width / (2 * dash)) if dashed else 1
    pieces = [((2 * k + 0.5) * dash, dash) for k in range(count)] if dashed else [(0.0, width)]
    if cell[0] != other[0]:
        return [Rectangle(x - 0.5 * Layout.line_mm, y + at, Layout.line_mm, long) for at, long in pieces]
    return [Rectangle(x + at, y - 0.5 * Layout.line_mm, long, Layout.line_mm) for at, long in pieces]


def _listed(ids: Sequence[int]) -> str:
    first, last = ids[0], ids[-1]
    if len(ids) == 1:
        return f"{first}"
    run = list(ids) == list(range(first, last + 1))
    return f"{first} to {last}" if run else ", ".join(map(str, ids))
