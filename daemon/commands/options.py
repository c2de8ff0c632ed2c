"""Options that several commands share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

HERE = Path("robot.toml")
VARIABLE = "BODYSCHEMA_ROBOT"
RobotFile = Annotated[Path, Parameter(env_var=VARIABLE, help="The robot's description.")]

SourceRobotFile = Annotated[
    Path | None,
    Parameter(show_default=False, help=f"robot.toml; else the one beside the source, {VARIABLE}, or here."),
]


def flag(text: str, *, name: str | None = None) -> Parameter:
    """An option without a value, which is off unless it is given."""
    return Parameter(name=name, help=text, negative="", show_default=False)


def several(text: str) -> Parameter:
    """An option that may be given more than once; without it there is none."""
    return Parameter(help=f"{text}; more than once for several.", negative="", show_default=False)


def robot_file(given: Path | None, source: Path | None) -> Path:
    """The robot.toml that was given; else the one beside `source`, else what the environment or the folder has."""
    if given is not None:
        return given
    if source is not None and (beside := source.parent / HERE).exists():
        return beside
    return Path(os.environ.get(VARIABLE, HERE))


BoardSquares = Annotated[str, Parameter(help="Columns and rows of the board's squares, as in 8x6.")]
BoardMarkerMm = Annotated[
    float | None, Parameter(help="Side of a marker [mm]; else 0.75 of a square.", show_default=False)
]
BoardDictionary = Annotated[
    str | None,
    Parameter(help="The markers' dictionary, as in 5X5_100; else the smallest of 4x4 bits.", show_default=False),
]
BoardPattern = Annotated[
    Literal["charuco", "chessboard"], Parameter(help="`chessboard` has no markers; all of it has to be in view.")
]
EyeImages = Annotated[Path, Parameter(help="Folder with the images: left01.png and right01.png, or left/ and right/.")]
LeftImages = Annotated[str | None, Parameter(help="Pattern of the left eye's files in it, as in cam0_*.png.")]
RightImages = Annotated[str | None, Parameter(help="Pattern of the right eye's.")]
SideBySide = Annotated[bool, flag("Each image shows both eyes, the left one in its left half.")]
RulerMm = Annotated[
    float | None,
    Parameter(
        help="What the line below the board measures on the print [mm]; else it is what it says.",
        validator=Number(gt=0),
        show_default=False,
    ),
]
