"""Robots that ship with the package."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.suggest import did_you_mean


def model_file(name: str) -> Path:
    """Return the path of robot.toml of the shipped model `name` (`upper_body`).

    Raises:
        ConfigError: there is no such model.
    """
    folder = Path(str(files(__name__)))
    known = sorted(file.parent.name for file in folder.glob("*/robot.toml"))
    if name not in known:
        raise ConfigError(f"there is no model {name!r}", remedy=did_you_mean(name, known))
    return folder / name / "robot.toml"
