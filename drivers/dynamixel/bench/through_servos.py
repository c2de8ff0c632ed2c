"""A simulated arm's joints, read by the driver from servos that stand where the simulation says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self

import msgspec

from drivers.dynamixel.config import DynamixelConfig
from drivers.dynamixel.joints import DynamixelJoints
from drivers.servos.health import BusHealth, ServoHealth
from interfaces.protocols import Clock, JointSource
from interfaces.records import JointReading, frozen_array

from .dry_run import DryRun
from .servo import Angle

ATTEMPTS = 5
READ_S = 0.5
# Servos and driver share a process, and perhaps the processor, with the simulation: answers may be as late as this.
LATENCY_MS = 40.0


class ThroughServos:
    """A `JointSource`: each reading of another source is told to the servos of a bench, and read from them.

    Questions and answers go through pseudo-terminals, dynamixel-sdk and all that the driver does. The other source's
    time stands still meanwhile, so its time stamps are kept; what changes is the encoders' resolution.
    """

    def __init__(
        self, source: JointSource, config: DynamixelConfig, clock: Clock, limits: Sequence[tuple[float, float]]
    ) -> None:
        """Nothing is opened yet.

        Args:
            source: gives the angles; its time runs only while it is read.
            config: the servos, checked; its ports are not used.
            clock: the machine's.
            limits: of each joint [rad].
        """
        self._source, self._config, self._clock, self._limits = source, config, clock, tuple(limits)
        self._opened = ExitStack()
        self._servos: DynamixelJoints | None = None
        self._q = [0.0] * len(source.joints)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in the order of q."""
        return self._source.joints

    @property
    def health(self) -> tuple[str, ...]:
        """As of the driver; nothing before it is opened, which the first reading does."""
        return () if self._servos is None else self._servos.health

    @property
    def servo_health(self) -> tuple[ServoHealth, ...]:
        """As of the driver."""
        return () if self._servos is None else self._servos.servo_health

    @property
    def bus_health(self) -> Mapping[str, BusHealth]:
        """As of the driver."""
        return {} if self._servos is None else self._servos.bus_health

    @property
    def record(self) -> tuple[Mapping[str, object], ...]:
        """As of the driver."""
        return () if self._servos is None else self._servos.record

    def __enter__(self) -> Self:
        self._opened.enter_context(self._source)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._servos = None
        self._opened.close()

    def read(self, timeout_s: float) -> JointReading | None:
        """The next reading; see `JointSource.read`. None also when the servos could not be read at its angles."""
        wanted = self._source.read(timeout_s)
        if wanted is None:
            return None
        self._q = wanted.q.tolist()
        servos = self._open_servos() if self._servos is None else self._servos
        for _ in range(ATTEMPTS):
            told = servos.read(READ_S)
            if told is not None:
                return JointReading(wanted.t, frozen_array(told.q))
        return None

    def _open_servos(self) -> DynamixelJoints:
        """The driver over the bench; not before the first angles are known, or the arm would jump there."""
        folder = Path(self._opened.enter_context(TemporaryDirectory(prefix="bodyschema-bench-")))
        links = {name: folder / name for name in self._config.buses}
        angles = {name: self._angle(place) for place, name in enumerate(self.joints)}
        buses = {name: msgspec.structs.replace(bus, latency_ms=LATENCY_MS) for name, bus in self._config.buses.items()}
        patient = msgspec.structs.replace(self._config, buses=buses)
        bench = self._opened.enter_context(DryRun(patient, angles, links))
        servos = DynamixelJoints(bench.config, self.joints, self._clock, limits=self._limits)
        self._servos = self._opened.enter_context(servos)
        return self._servos

    def _angle(self, place: int) -> Angle:
        return lambda _: self._q[place]
