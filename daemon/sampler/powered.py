"""Switch the torque of joints on or off on request."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from bodyschema.interfaces.errors import ConfigError, RequestError

from .sources import Powered

ANSWER_S = 1.5  # less than the 2 s that a query waits


def find_powered(drives: Iterable[object], name: str, file: Path) -> Powered:
    """Return the arm's drive of this name. ConfigError if robot.toml, `file`, does not configure it."""
    for drive in drives:
        if isinstance(drive, Powered) and drive.name == name:
            return drive
    remedy = f"Add the table [drivers.dynamixel.{name}]: docs/zero_force.md"
    raise ConfigError(f"{name} is not configured", file=file, remedy=remedy)


def asked(drive: Powered, *, on: bool) -> str:
    """Send a request to the reading thread and wait for its answer; cancel it on a timeout.

    Raises:
        RequestError: it is refused, or the servos are not being read.
    """
    answer = drive.ask(on)
    try:
        return answer.result(ANSWER_S)
    except TimeoutError as error:
        if not answer.cancel() and not answer.cancelled():
            raise RequestError(f"{drive.name}: being {'begun' if on else 'ended'}; see `bodyschema status`") from error
        raise RequestError(f"{drive.name}: the servos are not read at present; see `bodyschema status`") from error
