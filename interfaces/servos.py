"""Joints that are read from encoders and servos, as the processes and commands see them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from .protocols import JointSource


class Sample(Protocol):
    """A servo's sample; see `drivers.dynamixel.channel.Sample`."""

    @property
    def velocity(self) -> float: ...
    @property
    def current(self) -> float | None: ...


class Fitted(Protocol):
    """An identified servo; see `bodyschema.drivers.servos.handshake.IdentifiedServo`."""

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
    def servos(self) -> Sequence[Fitted]: ...

    @property
    def samples(self) -> Mapping[str, Sample | None]: ...
    @property
    def drives(self) -> Sequence[object]: ...
    def temperature_c(self, joint: str) -> float | None: ...
