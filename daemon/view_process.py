"""The page as a process beside those that work."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from interfaces.errors import ConfigError

PORT = 8420
NEEDED = ("starlette", "uvicorn")


def require_extra() -> None:
    """ConfigError unless the extra `view` is installed."""
    if any(find_spec(name) is None for name in NEEDED):
        raise ConfigError("the page needs the extra `view`", remedy="Install it: `pip install 'bodyschema[view]'`")


def view_command(robot_file: Path) -> list[str]:
    """The command line that shows this robot's page."""
    return [sys.executable, "-m", "daemon", "view", "--robot", str(robot_file)]
