"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

HERE = Path("robot.toml")
RobotFile = Annotated[Path, Parameter(env_var="BODYSCHEMA_ROBOT", help="The robot's description.")]


def flag(text: str, *, name: str | None = None) -> Parameter:
    """An option without a value, which is off unless it is given."""
    return Parameter(name=name, help=text, negative="", show_default=False)


def robot_file(given: Path | None, source: Path) -> Path:
    """The robot.toml that was given; else the one beside `source`, or in the working directory."""
    if given is not None:
        return given
    beside = source.parent / HERE
    return beside if beside.exists() else HERE
