"""Asking joints for torque, or for its end."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from bodyschema.interfaces.errors import ConfigError, RequestError

from .sources import Powered

ANSWER_S = 1.5  # a query waits for 2 s


def find_powered(drives: Iterable[object], name: str, file: Path) -> Powered:
    """The one of an arm's drives that has the name; ConfigError when robot.toml, `file`, does not configure it."""
    for drive in drives:
        if isinstance(drive, Powered) and drive.name == name:
            return drive
    remedy = f"Add the table [drivers.dynamixel.{name}]: docs/hardware.md"
    raise ConfigError(f"{name} is not configured", file=file, remedy=remedy)


def asked(drive: Powered, *, on: bool) -> str:
    """Ask, and wait for what the thread that reads says. What is not done in time is not done later.

    Raises:
        RequestError: it is refused, or nobody reads the servos.
    """
    answer = drive.ask(on)
    try:
        return answer.result(ANSWER_S)
    except TimeoutError as error:
        if not answer.cancel() and not answer.cancelled():
            raise RequestError(f"{drive.name}: being {'begun' if on else 'ended'}; see `bodyschema status`") from error
        raise RequestError(f"{drive.name}: the servos are not read at present; see `bodyschema status`") from error
