"""Interface of components that move joints from within the reading loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from bodyschema.interfaces.records import JointReading

from .bus import Bus
from .channel import Sample
from .handshake import FittedServo


class Drive(Protocol):
    """A component that moves or releases joints of an arm. Called by the reading thread, except `complaints`.

    Torque is off when it is opened. A servo fault never raises an exception: the joints are released.
    """

    @property
    def holding(self) -> frozenset[str]:
        """Joints whose torque may be on now."""
        ...

    @property
    def complaints(self) -> tuple[str, ...]:
        """Current problems, and what to do; from any thread."""
        ...

    def open(self, buses: Mapping[str, Bus], servos: Sequence[FittedServo]) -> None:
        """Accept the servos that were found, with torque verified off, in the order of the joints."""
        ...

    def step(self, reading: JointReading | None, samples: Mapping[str, Sample | None]) -> str | None:
        """Run once each cycle, after the request, with the reading (None when it was rejected) and the newest samples.

        Return why the joints had to be released in this cycle, so that the other drives release theirs too; else None.
        """
        ...

    def release(self, why: str | None) -> None:
        """Switch torque off and verify it on every joint as far as the bus allows. `why` is None at the regular end."""
        ...
