"""A simulated arm's joints, read by a driver from a bench that stands where the simulation says."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from bodyschema.drivers.servos.health import BusHealth, ServoHealth
from bodyschema.interfaces.protocols import JointSource
from bodyschema.interfaces.records import JointReading, frozen_array

from .dry_run import Angle

ATTEMPTS = 5
READ_S = 0.5
# Bench and driver share a process, and perhaps the processor, with the simulation: answers may be as late as this.
LATENCY_MS = 40.0


@dataclass(frozen=True)
class Behind:
    """A driver with its bench.

    Attributes:
        driver: is open.
        look: reads the joints of the bench as they are now; None when that did not work out.
    """

    driver: JointSource
    look: Callable[[], JointReading | None]


OpenBench = Callable[[Mapping[str, Angle]], AbstractContextManager[Behind]]
"""Puts joints, by name, on a bench, and opens the driver that reads them."""


class ThroughDriver:
    """A `JointSource`: each reading of another source is told to a bench, and read from it.

    All that the driver does is done, down to the bytes. The other source's time stands still meanwhile, so its time
    stamps are kept; what changes is the encoders' resolution.
    """

    def __init__(self, source: JointSource, open_bench: OpenBench) -> None:
        """Nothing is opened yet.

        Args:
            source: gives the angles; its time runs only while it is read.
        """
        self._source, self._open_bench = source, open_bench
        self._opened = ExitStack()
        self._behind: Behind | None = None
        self._q = [0.0] * len(source.joints)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in the order of q."""
        return self._source.joints

    @property
    def health(self) -> Sequence[str]:
        """As of the driver; nothing before it is opened, which the first reading does."""
        return self._of_driver("health", ())

    @property
    def servo_health(self) -> Sequence[ServoHealth]:
        """As of the driver, where it reads servos."""
        return self._of_driver("servo_health", ())

    @property
    def bus_health(self) -> Mapping[str, BusHealth]:
        """As of the driver, where it reads servos."""
        return self._of_driver("bus_health", {})

    @property
    def record(self) -> Sequence[Mapping[str, object]]:
        """As of the driver, where it keeps one."""
        return self._of_driver("record", ())

    def _of_driver(self, name: str, default: Any) -> Any:
        return default if self._behind is None else getattr(self._behind.driver, name, default)

    def __enter__(self) -> Self:
        self._opened.enter_context(self._source)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._behind = None
        self._opened.close()

    def read(self, timeout_s: float) -> JointReading | None:
        """The next reading; see `JointSource.read`. None also when the bench could not be read at its angles."""
        wanted = self._source.read(timeout_s)
        if wanted is None:
            return None
        self._q = wanted.q.tolist()
        if self._behind is None:  # not before the first angles are known, or the arm would jump there
            angles = {name: self._angle(place) for place, name in enumerate(self.joints)}
            self._behind = self._opened.enter_context(self._open_bench(angles))
        for _ in range(ATTEMPTS):
            told = self._behind.look()
            if told is not None:
                return JointReading(wanted.t, frozen_array(told.q))
        return None

    def _angle(self, place: int) -> Angle:
        return lambda _: self._q[place]
