"""Options that several commands share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

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
