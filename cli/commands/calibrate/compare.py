"""`bodyschema compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from bodyschema.cli.commands.options import flag, print_json


def compare(
    first: Annotated[Path, Parameter(help="A recording (.csv, .parquet) or a pair store (.sqlite).")],
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
    from bodyschema.cli.terminal.comparison_view import view
    from bodyschema.recordings import files as recordings
    from bodyschema.robot.description import RobotDescription

    joints = None if robot is None else RobotDescription.load(robot).joints
    one, other = (recordings.opened(file, joints) for file in (first, second))
    report = compared(one, other, (str(first), str(second)))
    if as_json:
        print_json(report)
        return
    Console(highlight=False).print(view(report))
