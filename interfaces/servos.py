"""Joints that are read from encoders and servos, as seen by the processes and commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import msgspec

from .protocols import JointSource


class Sample(Protocol):
    """A servo's reading; see `bodyschema.drivers.servos.channel.Sample`."""

    @property
    def velocity(self) -> float: ...
    @property
    def current(self) -> float | None: ...


class MountedServo(Protocol):
    """An identified servo; see `bodyschema.drivers.servos.servo.IdentifiedServo`."""

    @property
    def id(self) -> int: ...
    @property
    def direction(self) -> int: ...


class EncoderJoints(JointSource, Protocol):
    """A real arm's encoders, which report their health.

    See `bodyschema.drivers.serial_lines.joints.SerialLineJoints`.
    """

    @property
    def health(self) -> tuple[str, ...]: ...


@runtime_checkable
class ServoJoints(EncoderJoints, Protocol):
    """Encoders that are servos; see `bodyschema.drivers.servos.joints.ServoJoints`."""

    @property
    def servos(self) -> Sequence[MountedServo]: ...

    @property
    def samples(self) -> Mapping[str, Sample | None]: ...
    @property
    def drives(self) -> Sequence[object]: ...
    def temperature_c(self, joint: str) -> float | None: ...


class ServoStatus(msgspec.Struct, frozen=True):
    """One joint's servo.

    Attributes:
        bus: its bus in robot.toml.
        id: on the bus.
        model, firmware: as it reports them.
        homing_offset: [ticks]; 0 if the model has none.
        drive_mode: bits; 0 if the model has none.
        voltage_v: last value [V], updated every few seconds; null before the first.
        temperature_c: likewise [°C].
        current_a: [A]; null if not measured.
        troubles: problems with remedies; empty if none.
    """

    bus: str
    id: int
    model: str
    firmware: int
    homing_offset: int
    drive_mode: int
    voltage_v: float | None
    temperature_c: float | None
    current_a: float | None
    troubles: list[str]


class BusStatus(msgspec.Struct, frozen=True):
    """One bus of servos since the start.

    Attributes:
        exchanges: requests sent.
        answered: fraction answered correctly.
        troubles: the others, by error.
        way: read method, such as Sync Read; empty before the bus is open.
    """

    exchanges: int
    answered: float
    troubles: dict[str, int]
    way: str = ""


@dataclass(frozen=True, slots=True)
class FoundServo:
    """A servo that answered.

    Attributes:
        port: its port.
        baud: bits per second.
        protocol: name of the protocol, such as "Dynamixel 2.0".
        id: ID on the bus.
        firmware: version in the vendor's notation.
        model: name, or number if the model is unknown; None if not reported.
        voltage_v, temperature_c: as measured by the servo; None if not reported.
        has_torque: True if the motor holds its position; None if not reported.
        troubles: its problems, with the remedies.
        is_double: True if several servos answer to this ID.
    """

    port: str
    baud: int
    protocol: str
    id: int
    model: str | None = None
    firmware: str | None = None
    voltage_v: float | None = None
    temperature_c: float | None = None
    has_torque: bool | None = None
    troubles: tuple[str, ...] = ()
    is_double: bool = False


@dataclass(frozen=True, slots=True)
class ScannedBus:
    """Result of scanning one port.

    Attributes:
        port: the scanned port.
        servos: the servos that answered.
        trouble: reason why the scan failed or was cut short, or None.
    """

    port: str
    servos: tuple[FoundServo, ...]
    trouble: str | None = None
