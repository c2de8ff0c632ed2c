"""Read a simulated arm's joints through a real driver and emulated servos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from typing import Any, Self

from bodyschema.interfaces.protocols import JointSource
from bodyschema.interfaces.records import JointReading, frozen_array
from bodyschema.interfaces.servos import BusStatus, ServoStatus

from .device import Angle


class ThroughDriverSettings:
    attempts: int = 5  # of reading
    read_s: float = 0.5  # how long a reading is waited for
    # Emulator, driver and simulation share a process and perhaps a core, so answers may be this late.
    latency_ms: float = 40.0


@dataclass(frozen=True)
class Behind:
    """An open driver and its emulator."""

    driver: JointSource  # the open driver
    # reads the emulated joints at their present angles; None when the reading failed
    look: Callable[[], JointReading | None]


OpenEmulator = Callable[[Mapping[str, Angle]], AbstractContextManager[Behind]]
"""Puts joints, by name, on an emulator, and opens the driver that reads them."""


class ThroughDriver:
    """A `JointSource` that passes each reading of another source through an emulator and a driver.

    The driver does all its work, down to the bytes. The other source's clock stands still meanwhile, so its timestamps
    are kept. Only the encoder resolution changes the angles.
    """

    def __init__(self, source: JointSource, open_emulator: OpenEmulator) -> None:
        """Prepare without opening anything.

        Args:
            source: gives the angles; its clock advances only while it is read.
        """
        self._source, self._open_emulator = source, open_emulator
        self._opened = ExitStack()
        self._behind: Behind | None = None
        self._q = [0.0] * len(source.joints)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in the order of q."""
        return self._source.joints

    @property
    def health(self) -> Sequence[str]:
        """Health messages of the driver; empty until the first reading opens it."""
        return self._of_driver("health", ())

    @property
    def servo_health(self) -> Mapping[str, ServoStatus]:
        """Servo health as reported by the driver, if it reads servos."""
        return self._of_driver("servo_health", {})

    @property
    def bus_health(self) -> Mapping[str, BusStatus]:
        """Bus health as reported by the driver, if it reads servos."""
        return self._of_driver("bus_health", {})

    @property
    def record(self) -> Sequence[Mapping[str, object]]:
        """Raw record of the driver, if it keeps one."""
        return self._of_driver("record", ())

    def _of_driver(self, name: str, default: Any) -> Any:
        return default if self._behind is None else getattr(self._behind.driver, name, default)

    def __enter__(self) -> Self:
        self._opened.enter_context(self._source)
        return self

    def __exit__(self, *_: object) -> None:
        self._behind = None
        self._opened.close()

    def read(self, timeout_s: float) -> JointReading | None:
        """Return the next reading; see `JointSource.read`. Return None also when the emulator could not be read."""
        source_reading = self._source.read(timeout_s)
        if source_reading is None:
            return None
        self._q = source_reading.q.tolist()
        if self._behind is None:  # only once the first angles are known, or the arm would jump there
            angles = {name: self._angle(place) for place, name in enumerate(self.joints)}
            self._behind = self._opened.enter_context(self._open_emulator(angles))
        for _ in range(ThroughDriverSettings.attempts):
            driver_reading = self._behind.look()
            if driver_reading is not None:
                return JointReading(source_reading.t, frozen_array(driver_reading.q))
        return None

    def _angle(self, place: int) -> Angle:
        return lambda _: self._q[place]
