"""An arm of Dynamixel servos as a `JointSource`."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from bodyschema.drivers.device_clock import DeviceClock
from bodyschema.drivers.dynamixel.bus import Bus, sync_request
from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig
from bodyschema.drivers.dynamixel.models import BY_NUMBER, HARDWARE_ERRORS, TICK_S, TICKS
from bodyschema.drivers.dynamixel.packets import ALERT
from bodyschema.drivers.dynamixel.port import SafePort
from bodyschema.drivers.dynamixel.settings import settings_of
from bodyschema.drivers.serial_line import adapter_latency_s
from bodyschema.drivers.servos.bus import Answer
from bodyschema.drivers.servos.bus import Bus as ServoBus
from bodyschema.drivers.servos.channel import Channel as ServoChannel
from bodyschema.drivers.servos.channel import Sample
from bodyschema.drivers.servos.drive import Drive
from bodyschema.drivers.servos.handshake import FittedServo
from bodyschema.drivers.servos.joints import OpenPort, ServoJoints
from bodyschema.drivers.servos.make import Make
from bodyschema.drivers.servos.model import Layout
from bodyschema.drivers.servos.plan import Way
from bodyschema.drivers.servos.port import Port
from bodyschema.interfaces.protocols import Clock

BLOCK2 = struct.Struct("<HBBhhii")  # tick, moving, moving status, PWM, current, velocity, position
BLOCK1 = struct.Struct("<hHHBBBBB")  # position, speed, load, voltage, temperature, registered, reserved, moving
LARGEST_PWM = 2009  # of the P series; the others have less
SIGN1, NUMBER1 = 0x400, 0x3FF  # sign and magnitude of Protocol 1.0
LARGEST_POSITION1 = 28_672  # in multi-turn mode


class Channel(ServoChannel):
    """The answers of one servo since the bus was opened."""

    def __init__(self, servo: FittedServo) -> None:
        """Start without answers."""
        super().__init__(servo)
        self._clock = DeviceClock(TICK_S, TICKS)

    def _sample(self, answer: Answer) -> Sample | None:
        return self._of_protocol2(answer) if self.servo.model.protocol == 2 else self._of_protocol1(answer)

    def _of_protocol2(self, answer: Answer) -> Sample | None:
        stamp, moving, _, pwm, current, velocity, position = BLOCK2.unpack(answer.status.data)
        if moving > 1 or abs(pwm) > LARGEST_PWM or stamp >= TICKS:
            return None
        between = self._clock.narrow(answer.earliest, answer.latest, stamp)
        if between is None:
            return None
        model = self.servo.model
        amperes = None if model.current_unit is None else current * model.current_unit
        alert = bool(answer.status.error & ALERT)
        way = (self.question(answer), answer.earliest)
        return Sample(*way, *between, position, velocity * model.velocity_unit, amperes, bool(moving), alert)

    def _of_protocol1(self, answer: Answer) -> Sample | None:
        position, speed, _, voltage, temperature, registered, _, moving = BLOCK1.unpack(answer.status.data)
        if moving > 1 or registered > 1 or not self._is_possible(position) or not self._is_steady(voltage, temperature):
            return None
        velocity = (speed & NUMBER1) * self.servo.model.velocity_unit * (-1 if speed & SIGN1 else 1)
        alert = answer.status.error != 0
        way = (self.question(answer), answer.earliest)
        return Sample(*way, answer.earliest, answer.latest, position, velocity, None, bool(moving), alert)

    def _is_possible(self, position: int) -> bool:
        if self.servo.model.ticks_per_turn is None:
            return 0 <= position <= NUMBER1
        return abs(position) <= LARGEST_POSITION1


def ways_of(bus: ServoBus, servos: Sequence[FittedServo], config: BusConfig) -> list[list[Way]]:
    """Return the read methods of each group: Protocol 1.0 as one, and each series of Protocol 2.0."""
    alone = [servo for servo in servos if servo.model.protocol == 1]
    series: dict[int, list[FittedServo]] = {}
    for servo in servos:
        if servo.model.protocol == 2:
            series.setdefault(servo.model.layout.block.address, []).append(servo)
    groups = [
        _ways_of_series(group[0].model.layout, [servo.id for servo in group], try_fast=config.fast_sync_read == "auto")
        for group in series.values()
    ]
    if alone:
        requests = (bus.read_request(servo.model, servo.id, servo.model.layout.block) for servo in alone)
        groups.insert(0, [Way("one by one", tuple(requests))])
    return groups


def _ways_of_series(layout: Layout, ids: Sequence[int], *, try_fast: bool) -> list[Way]:
    sync = Way("Sync Read", (sync_request(layout, ids, fast=False),))
    if len(ids) < 2 or not try_fast:
        return [sync]
    return [Way("Fast Sync Read", (sync_request(layout, ids, fast=True),)), sync]


def open_serial(config: BusConfig, clock: Clock) -> tuple[Port, float]:
    """Open the port of a bus; return it and the latency of its adapter [s]."""
    latency_s = adapter_latency_s(config.port) if config.latency_ms is None else config.latency_ms * 1e-3
    port = SafePort(config.port, config.baud, latency_s=latency_s, now=clock.now)
    port.openPort()
    return port, latency_s


DYNAMIXEL = Make(
    DynamixelConfig.table,
    BY_NUMBER,
    HARDWARE_ERRORS,
    Bus,
    Channel,
    ways_of,
    settings_of,
    1,
    TICK_S,
)


class DynamixelJoints(ServoJoints):
    """An arm of Dynamixel servos as a `JointSource`; see `ServoJoints`."""

    def __init__(
        self,
        config: DynamixelConfig,
        joints: Sequence[str],
        clock: Clock,
        *,
        limits: Sequence[tuple[float, float]] | None = None,
        last_pose: Sequence[float] | None = None,
        open_port: OpenPort = open_serial,
        drives: Sequence[Drive] = (),
    ) -> None:
        """Prepare without opening anything; arguments as in `ServoJoints`."""
        super().__init__(
            DYNAMIXEL, config, joints, clock, open_port=open_port, limits=limits, last_pose=last_pose, drives=drives
        )
