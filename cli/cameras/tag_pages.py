"""Create pages of tags, and the matching tables of robot.toml."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal

from bodyschema.interfaces.errors import ConfigError
from bodyschema.vision.board import Board
from bodyschema.vision.board.board import MARKER_SHARE
from bodyschema.vision.board.page import page as board_page
from bodyschema.vision.cluster.page import FACE_SIDES, shape_page, tags_page
from bodyschema.vision.cluster.shapes import Shape, chessboard, cube, plate
from bodyschema.vision.cluster.tables import chessboard_tables, cluster_tables, tag_tables
from bodyschema.vision.printing import Page
from bodyschema.vision.tags.config import Dictionary

from .board_pages import printed_scale

ShapeName = Literal["tags", "plate", "cube", "board", "chessboard"]
_RUN = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?")


@dataclass(frozen=True)
class Tags:
    shape: ShapeName = "tags"  # single tags, or one body of them
    ids: str | None = None  # numbers of the tags as in 0-5,9; None: as many as the shape has, from 0 on
    dictionary: Dictionary = "apriltag_36h11"
    side_mm: float = 40.0  # side of the black squares
    # columns, rows: tags of a plate, or squares of a board
    columns: int = 2
    rows: int = 1
    fold_deg: float = 0.0  # fold angle of a plate [°]

    @property
    def body(self) -> Shape | None:
        """The body of the tags; None if they are cut apart."""
        match self.shape:
            case "tags" | "chessboard":
                return None
            case "cube":
                return cube()
            case "plate":
                return plate(self.columns, self.rows, self.fold_deg)
            case "board":
                return chessboard(self.columns, self.rows)

    @property
    def numbers(self) -> list[int]:
        """Numbers of the tags; raises ConfigError if they cannot be parsed, or one is repeated."""
        if self.ids is None:
            return list(range(1 if self.body is None else len(self.body.faces)))
        return numbers_of(self.ids)


def numbers_of(ids: str, most: int = 100) -> list[int]:
    """Parse tag numbers as in 0-5,9; raise ConfigError if they cannot be parsed, or one is repeated."""
    found: list[int] = []
    for part in ids.split(","):
        run = _RUN.fullmatch(part.strip())
        if run is None:
            raise ConfigError(f"--ids {ids} is not as in 0-5,9", remedy="Give numbers, or runs of them")
        found += range(int(run[1]), int(run[2] or run[1]) + 1)[: most + 1]
    if len(found) > most:
        raise ConfigError(f"--ids {ids} are more than {most}", remedy="Print them on several pages")
    if len(set(found)) < len(found) or not found:
        raise ConfigError(f"--ids {ids} has a tag twice, or none", remedy="No number may be there twice")
    return found


def sheet(tags: Tags, paper: str) -> Page:
    """Lay out the page; raise ConfigError if a tag is unknown, or they do not fit."""
    if tags.shape == "board":
        if tags.ids is not None:
            raise ConfigError("the tags of a board are numbered from 0", remedy="Leave out --ids")
        family = tags.dictionary.replace("aruco_6x6", "6X6").replace("apriltag", "APRILTAG")
        return board_page(Board(tags.columns, tags.rows, 1e-3 * face_mm(tags), dictionary=family), paper)
    if tags.shape == "chessboard":
        tables(tags)  # raises if such a marker is impossible
        return board_page(Board(tags.columns, tags.rows, 1e-3 * tags.side_mm, pattern="chessboard"), paper)
    body, ids = tags.body, tags.numbers
    if body is None:
        return tags_page(ids, tags.dictionary, tags.side_mm, paper)
    return shape_page(body, ids, tags.dictionary, tags.side_mm, paper)


def face_mm(tags: Tags) -> float:
    """Return the width of a face between cuts or folds, or of a board's square [mm]."""
    if tags.shape == "chessboard":
        return tags.side_mm
    return tags.side_mm / MARKER_SHARE if tags.shape == "board" else FACE_SIDES * tags.side_mm


def tables(tags: Tags) -> str:
    """Return the tables of robot.toml for the nominal shape; for single tags those of the first one."""
    body, side_m = tags.body, 1e-3 * tags.side_mm
    if tags.shape == "chessboard":
        return chessboard_tables(tags.columns, tags.rows, side_m)
    if body is None:
        return tag_tables(tags.dictionary, side_m, tags.numbers[0])
    return cluster_tables(tags.dictionary, side_m, body.placed(tags.numbers, 1e-3 * face_mm(tags)))


def as_printed(tags: Tags, drawn_mm: float, measured_mm: float) -> Tags:
    """Scale the tags by their page's ruler of `drawn_mm`; raise ConfigError if the length is implausible."""
    return replace(tags, side_mm=printed_scale(drawn_mm, measured_mm) * tags.side_mm)
