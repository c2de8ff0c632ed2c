"""A cluster as the tables of robot.toml."""

from __future__ import annotations

from collections.abc import Sequence

from bodyschema.interfaces.errors import ConfigError
from bodyschema.vision.tags.config import ChessboardConfig, Dictionary, PlacedTag, Vector


def cluster_tables(dictionary: Dictionary, side_m: float, tags: Sequence[PlacedTag], notes: Sequence[str] = ()) -> str:
    """Return the tables [vision], [vision.tag] and [[vision.cluster.tags]].

    Args:
        notes: a comment for each tag, behind its number.
    """
    lines = ["[vision]", 'marker = "cluster"', "", *_tag_table(dictionary, side_m)]
    for k, tag in enumerate(tags):
        note = f"  # {notes[k]}" if notes and notes[k] else ""
        lines += ["", "[[vision.cluster.tags]]", f"id = {tag.id}{note}"]
        lines += [f"xyz = {_list(tag.xyz)}", f"rpy = {_list(tag.rpy)}"]
        if tag.side_m is not None:
            lines.append(f"side_m = {tag.side_m:.6g}")
    return "\n".join(lines) + "\n"


def chessboard_tables(columns: int, rows: int, square_m: float) -> str:
    """Return the tables [vision] and [vision.chessboard]; raise ConfigError if it cannot be a marker."""
    try:
        ChessboardConfig(columns=columns, rows=rows, square_m=square_m)
    except ValueError as error:
        raise ConfigError(str(error), remedy="Give other --columns and --rows") from error
    size = f"columns = {columns}\nrows = {rows}\nsquare_m = {square_m:.6g}"
    return f'[vision]\nmarker = "chessboard"\n\n[vision.chessboard]\n{size}\n'


def tag_tables(dictionary: Dictionary, side_m: float, id: int) -> str:
    """Return the tables [vision] and [vision.tag] of a single tag."""
    return "\n".join(["[vision]", 'marker = "tag"', "", *_tag_table(dictionary, side_m), f"id = {id}"]) + "\n"


def _tag_table(dictionary: Dictionary, side_m: float) -> list[str]:
    return ["[vision.tag]", f'dictionary = "{dictionary}"', f"side_m = {side_m:.6g}"]


def _list(values: Vector) -> str:
    return "[" + ", ".join(f"{value:.6f}" for value in values) + "]"
