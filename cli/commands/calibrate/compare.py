"""`bodyschema compare`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console, Group
from rich.padding import Padding
from rich.text import Text

from bodyschema.cli.commands.options import flag, print_json

if TYPE_CHECKING:
    from bodyschema.calibration.comparison import ComparisonReport, Distances, LeftOut


def compare(
    first: Annotated[Path, Parameter(help="A recording (.csv, .parquet) or a sample store (.sqlite).")],
    second: Annotated[Path, Parameter(help="Another, at the same joint angles.")],
    /,
    *,
    robot: Annotated[
        Path | None, Parameter(help="robot.toml, which names the joints; else all other columns are joints.")
    ] = None,
    as_json: Annotated[bool, flag("Print the figures as JSON.", name="--json")] = False,
) -> None:
    """Compare the positions of two recordings row by row.

    Rows match where all joints agree to 1e-6 rad (1e-6 m for a prismatic joint); other rows are reported and left out.
    If the recordings have different numbers of rows, each row is compared with the one at the same joint angles.

    Needs: two recordings at the same joint angles, for example a measured one and one from `bodyschema simulate`.

    Next: `bodyschema simulate` with another robot.toml; `bodyschema calibrate`.
    """
    from bodyschema.calibration.comparison import compared
    from bodyschema.recordings import files as recordings
    from bodyschema.robot.description import RobotDescription

    joints = None if robot is None else RobotDescription.load(robot).joints
    one, other = (recordings.opened(file, joints) for file in (first, second))
    report = compared(one, other, (str(first), str(second)))
    if as_json:
        print_json(report)
        return
    Console(highlight=False).print(view(report))


def view(report: ComparisonReport) -> Group:
    """Return a view of the compared recordings, the figures and the worst rows."""
    from bodyschema.cli.terminal.screen import ruled_table

    figures = ruled_table("", "mean", "RMS", "median", "max")
    figures.add_row(Text("distance [mm]"), *_row(report.distances))
    if report.aligned is not None:
        figures.add_row(Text("after best rigid alignment [mm]"), *_row(report.aligned.distances))
    axes = ruled_table(f"{report.second} minus {report.first}", "x", "y", "z")
    axes.add_row(Text("mean [mm]"), *map(_number, report.axis_mean_mm))
    axes.add_row(Text("RMS [mm]"), *map(_number, report.axis_rms_mm))
    worst = ruled_table("worst rows", "row", "[mm]", "x", "y", "z")
    for row in report.worst:
        number = f"{row.row}" if row.row == row.other_row else f"{row.row}, {row.other_row}"
        worst.add_row("", number, _number(row.distance_mm), *map(_number, row.apart_mm))
    parts = [figures, axes, worst]
    return Group(*(Text(sentence) for sentence in sentences(report)), *(Padding(part, (1, 0, 0, 0)) for part in parts))


def sentences(report: ComparisonReport) -> list[str]:
    """Return the comparison as sentences, the result first."""
    from bodyschema.cli.terminal.screen import mm

    distances, left = report.distances, report.left_out
    lines = [
        f"{report.second} is {mm(distances.mean_mm / 1e3)} from {report.first} on average, "
        f"{mm(distances.max_mm / 1e3)} at most, over {report.compared} rows of the same joint angles."
    ]
    if report.rows != report.other_rows:
        lines.append(
            f"{report.first} has {report.rows} rows, {report.second} {report.other_rows}: rows of the same joint "
            "angles were compared."
        )
    if left.first or left.second:
        lines.append(_not_compared(report, left))
    if report.aligned is not None:
        moved = mm(sum(part**2 for part in report.aligned.shift_mm) ** 0.5 / 1e3)
        lines.append(
            f"A turn of {report.aligned.turn_deg:.3g}° and a shift of {moved} as a whole leave "
            f"{mm(report.aligned.distances.mean_mm / 1e3)}."
        )
    return lines


def _not_compared(report: ComparisonReport, left: LeftOut) -> str:
    parts = [
        f"{count} of {name} (the first is number {number})"
        for count, name, number in (
            (left.first, report.first, left.first_row),
            (left.second, report.second, left.second_row),
        )
        if count
    ]
    why = "" if left.joint is None else f" In row {left.first_row} {left.joint} differs by {left.by:.4g} rad or m."
    return f"Not compared, since the other has no row at their joint angles: {' and '.join(parts)}.{why}"


def _row(distances: Distances) -> Sequence[str]:
    return [_number(value) for value in (distances.mean_mm, distances.rms_mm, distances.median_mm, distances.max_mm)]


def _number(value_mm: float) -> str:
    return f"{value_mm:.3f}"
