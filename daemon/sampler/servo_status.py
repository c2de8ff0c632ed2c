"""Servo health in the sampler's status, if the joints are servos."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from bodyschema.daemon.transport.status import BusStatus, ServoStatus
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.protocols import JointSource
from bodyschema.interfaces.servos import BusHealth, ServoHealth

log = logging.getLogger(__name__)


@runtime_checkable
class TellsHealth(Protocol):
    """Encoders that report their health."""

    @property
    def health(self) -> Sequence[str]:
        """Problems, with remedies."""


@runtime_checkable
class Servos(TellsHealth, Protocol):
    """Encoders that are servos; see `bodyschema.drivers.servos.joints.ServoJoints`."""

    @property
    def servo_health(self) -> Sequence[ServoHealth]: ...
    @property
    def bus_health(self) -> Mapping[str, BusHealth]: ...


@runtime_checkable
class AsksForTurns(Protocol):
    """Encoders that may have lost a joint's turn count."""

    @property
    def asks_for_turns(self) -> bool: ...
    def accept_turns(self) -> None:
        """Assume the turns nearest to the joints' last positions."""


def complaints_of(joints: JointSource) -> list[str]:
    """Return the problems that the encoders report."""
    return list(joints.health) if isinstance(joints, TellsHealth) else []


def servos_of(joints: JointSource) -> dict[str, ServoStatus]:
    """Return each joint's servo."""
    if not isinstance(joints, Servos):
        return {}
    return {servo.joint: _status(servo) for servo in joints.servo_health}


def buses_of(joints: JointSource) -> dict[str, BusStatus]:
    """Return each bus's statistics since the start."""
    if not isinstance(joints, Servos):
        return {}
    return {name: _bus(bus) for name, bus in joints.bus_health.items()}


def _status(servo: ServoHealth) -> ServoStatus:
    return ServoStatus(
        bus=servo.bus,
        id=servo.id,
        model=servo.model,
        firmware=servo.firmware,
        homing_offset=servo.homing_offset,
        drive_mode=servo.drive_mode,
        voltage_v=None if servo.voltage_v is None else round(servo.voltage_v, 1),
        temperature_c=servo.temperature_c,
        current_a=None if servo.current_a is None else round(servo.current_a, 3),
        troubles=list(servo.troubles),
    )


def _bus(bus: BusHealth) -> BusStatus:
    failed = sum(bus.troubles.values())
    answered = 1.0 - failed / bus.exchanges if bus.exchanges else 0.0
    return BusStatus(bus.exchanges, round(answered, 5), dict(bus.troubles), bus.way)


def accept_turns(encoders: object) -> str:
    """Set lost turn counts to the turns nearest to the last positions; return a message.

    Raise RequestError if no turn count was lost.
    """
    if not isinstance(encoders, AsksForTurns) or not encoders.asks_for_turns:
        raise RequestError("no joint has lost its turn count: there is nothing to accept")
    encoders.accept_turns()
    log.info("accept_turns: the turns nearest to where the joints were are taken")
    return "the turns nearest to where the joints were are taken; pairs go on in a new segment"
