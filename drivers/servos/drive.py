"""What moves joints in the loop that reads them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from bodyschema.interfaces.records import JointReading

from .bus import Bus
from .channel import Sample
from .handshake import FittedServo


class Drive(Protocol):
    """Moves some joints of an arm, or lets go of them. Called by the thread that reads, but for `complaints`.

    Torque is off when it is opened. It never raises because something went wrong with a servo: it lets go.
    """

    @property
    def holding(self) -> frozenset[str]:
        """Joints whose torque may be on now."""
        ...

    @property
    def complaints(self) -> tuple[str, ...]:
        """What is wrong, and what to do; from any thread."""
        ...

    def open(self, buses: Mapping[str, Bus], servos: Sequence[FittedServo]) -> None:
        """The servos were found, with their torque verified off; in the order of the joints."""
        ...

    def step(self, reading: JointReading | None, samples: Mapping[str, Sample | None]) -> str | None:
        """Once each cycle, after the question: the reading, None when it was doubtful, and the newest samples.

        Why it had to let go in this cycle, which is reason for the other drives to let go too; else None.
        """
        ...

    def release(self, why: str | None) -> None:
        """Torque off, verified on every joint as far as the bus allows; None when that is the orderly end."""
        ...
