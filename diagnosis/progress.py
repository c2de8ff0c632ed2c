"""Report the stage of a diagnosis and the approximate share of the work done."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of the work."""

    what: str  # short description
    ends: float  # share of the work done at its end [%], from times of some hundred pairs


SETS = Stage("comparing sets of causes", 45.0)
SEARCH = Stage("searching for further causes", 65.0)
UNNAMED = Stage("asking whether something without a name is at work", 80.0)
RIVALS = Stage("asking what else it could be", 95.0)


class Stages:
    """Messages with a percentage that never falls.

    Args:
        tell: called with each message.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._stage, self._done = SETS, 0.0

    def begin(self, stage: Stage, before: Stage | None = None) -> None:
        """Report that a stage begins; `before` is the stage that has just ended."""
        self._stage = stage
        self._done = max(self._done, 0.0 if before is None else before.ends)
        self._report(stage.what)

    def __call__(self, message: str) -> None:
        """Report a step of the current stage."""
        # The number of steps of a stage is unknown: each takes a quarter of what is left of it.
        self._done += max(self._stage.ends - self._done, 0.0) * 0.25
        self._report(f"{self._stage.what}: {message}")

    def _report(self, message: str) -> None:
        self._tell(f"{self._done:.0f} %, {message}")
