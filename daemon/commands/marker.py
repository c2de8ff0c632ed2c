"""`bodyschema marker`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import cyclopts
from cyclopts import Parameter

from daemon.commands.options import flag

marker = cyclopts.App(
    name="marker",
    help="""What the marker looks like.

    Needs: images of the camera, taken in the light and at the exposure of later.

    Next: `bodyschema marker learn`.
    """,
)


@marker.command
def learn(
    *images: Annotated[Path, Parameter(help="Image files of one camera; with --auto in the order of time.")],
    at: Annotated[
        tuple[float, float] | None,
        Parameter(help="Column and row of a pixel in the middle of the ball, in the first image [px]."),
    ] = None,
    auto: Annotated[bool, flag("Learn the colour of what moves; the camera stands still.")] = False,
) -> None:
    """Learn a ball's colour from images, and print the table [vision.colour] for robot.toml.

    Either --at: the ball is all that has the colour of that pixel and joins it. Or --auto: three images or more, in
    which the ball moves; the most colourful thing that moves is taken.

    Needs: image files, no hardware.

    Next: put what was printed into robot.toml, in the place of `colour = ...`.
    """
    from daemon.marker_wiring import learnt_colour_table
    from interfaces.errors import BodyschemaError

    if not images or auto == (at is not None):
        raise BodyschemaError("give image files, and either --at COLUMN ROW or --auto")
    sys.stdout.write(learnt_colour_table(images, at))
