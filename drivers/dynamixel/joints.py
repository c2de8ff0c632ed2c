"""An arm of Dynamixel servos as a `JointSource`: their settings, read methods and answers.

`drivers/servos/joints.py` converts the answers to joint readings.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from typing import get_args

from bodyschema.drivers.device_clock import DeviceClock
from bodyschema.drivers.dynamixel.bus import Bus, sync_request
from bodyschema.drivers.dynamixel.config import Baud, BusConfig, DynamixelConfig
from bodyschema.drivers.dynamixel.packets import ALERT
from bodyschema.drivers.servos.bus import Answer
from bodyschema.drivers.servos.bus import Bus as ServoBus
from bodyschema.drivers.servos.channel import Channel as ServoChannel
from bodyschema.drivers.servos.channel import Sample
from bodyschema.drivers.servos.joints import ServoJoints
from bodyschema.drivers.servos.model import Model, Register
from bodyschema.drivers.servos.servo import IdentifiedServo
from bodyschema.drivers.servos.settings import (
    BAUD,
    HOMING_OFFSET,
    ID,
    LARGEST_ID,
    OTHER_RATE,
    OTHER_ZERO,
    RENAMED,
    Setting,
)
from bodyschema.drivers.servos.vendor import ReadMethod, ServoVendor, one_by_one

from .models import (
    BAUDS1,
    BY_NUMBER,
    CURRENT_MODES,
    HARDWARE_ERRORS,
    LAYOUT_MX1,
    MODES,
    NEAR_OFFSET,
    NUMBER1,
    SIGN1,
    TICK_S,
    TICKS,
    baud_value,
)

FARTHEST_OFFSET = 1_044_479  # 255 turns


def settings_of(model: Model) -> Sequence[Setting]:
    """Return the settings of a model, in the order of their addresses."""
    found = _of_protocol1(model) if model.protocol == 1 else _of_protocol2(model)
    return sorted(found, key=lambda setting: setting.register.address)


def _common(model: Model) -> Iterator[Setting]:
    layout = model.layout
    bauds = BAUDS1 if model.protocol == 1 else get_args(Baud)
    yield Setting(ID, layout["id"], 0, LARGEST_ID, follows=RENAMED)
    yield Setting(
        BAUD, layout["baud"], 0, 254, {str(baud): baud_value(layout, baud) for baud in bauds}, follows=OTHER_RATE
    )
    yield Setting("return_delay", layout["return_delay"], 0, 254, per_unit=2, unit="µs")
    yield Setting("shutdown", layout["shutdown"], 0, 0x7F, follows="which troubles switch its torque off")


def _of_protocol2(model: Model) -> Iterator[Setting]:
    layout, degrees = model.layout, math.degrees(model.rad_per_tick)
    yield from _common(model)
    yield Setting("drive_mode", layout["drive_mode"], 0, 0x0D, follows=f"bit 0: it counts the other way; {OTHER_ZERO}")
    modes = MODES | (dict(CURRENT_MODES) if model.current_unit is not None else {})
    turns = "its turn count may be lost"
    if model.series == "P":
        modes.pop("current_position", None)
    else:
        turns += f"; in position mode a homing_offset beyond ±{NEAR_OFFSET} is ignored"
    yield Setting("operating_mode", layout["operating_mode"], 0, 16, modes, follows=turns)
    yield Setting("secondary_id", Register(12, 1), 0, 255, follows="above 252: none")
    farthest = FARTHEST_OFFSET if model.series != "P" else 2**31 - 1
    homing = (layout["homing_offset"], -farthest, farthest)
    yield Setting(HOMING_OFFSET, *homing, per_unit=degrees, unit="°", follows=OTHER_ZERO)
    yield Setting("moving_threshold", layout["moving_threshold"], 0, 2**31 - 1)
    yield Setting("temperature_limit", Register(31, 1), 0, 100, unit="°C")
    yield Setting("max_voltage_limit", Register(32, 2), 60, 400, per_unit=0.1, unit="V")
    yield Setting("min_voltage_limit", Register(34, 2), 30, 400, per_unit=0.1, unit="V")
    yield Setting("pwm_limit", Register(36, 2), 0, 2009)
    if model.current_unit is not None:
        yield Setting("current_limit", Register(38, 2), 0, 2**15 - 1, per_unit=model.current_unit, unit="A")
    yield Setting("velocity_limit", Register(44, 4), 0, 2**31 - 1)
    bounds = (0, 4095) if model.series != "P" else (-(2**31), 2**31 - 1)
    yield Setting("max_position_limit", Register(48, 4, signed=True), *bounds)
    yield Setting("min_position_limit", Register(52, 4, signed=True), *bounds)


def _of_protocol1(model: Model) -> Iterator[Setting]:
    yield from _common(model)
    ticks = 4095 if model.layout is LAYOUT_MX1 else 1023
    yield Setting("cw_angle_limit", Register(6, 2), 0, ticks)
    yield Setting("ccw_angle_limit", Register(8, 2), 0, ticks)
    yield Setting("temperature_limit", Register(11, 1), 0, 99, unit="°C")
    yield Setting("min_voltage_limit", Register(12, 1), 50, 160, per_unit=0.1, unit="V")
    yield Setting("max_voltage_limit", Register(13, 1), 50, 160, per_unit=0.1, unit="V")
    yield Setting("max_torque", Register(14, 2), 0, 1023)
    # With 0 the servo answers no read, so the written value could not be verified.
    yield Setting("status_return", model.layout["status_return"], 1, 2)
    yield Setting("alarm_led", Register(17, 1), 0, 0x7F)
    if model.layout is LAYOUT_MX1:
        degrees = math.degrees(model.rad_per_tick)
        offset = Register(20, 2, signed=True)
        yield Setting("multi_turn_offset", offset, -24_576, 24_576, per_unit=degrees, unit="°", follows=OTHER_ZERO)
        yield Setting("resolution_divider", Register(22, 1), 1, 4, follows=OTHER_ZERO)


BLOCK2 = struct.Struct("<HBBhhii")  # tick, moving, moving status, PWM, current, velocity, position
BLOCK1 = struct.Struct("<hHHBBBBB")  # position, speed, load, voltage, temperature, registered, reserved, moving
LARGEST_PWM = 2009  # of the P series; the others have less
LARGEST_POSITION1 = 28_672  # in multi-turn mode


class Channel(ServoChannel):
    """The answers of one servo since the bus was opened."""

    def __init__(self, servo: IdentifiedServo) -> None:
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
        timing = (self.request_key(answer), answer.earliest)
        return Sample(*timing, *between, position, velocity * model.velocity_unit, amperes, bool(moving), alert)

    def _of_protocol1(self, answer: Answer) -> Sample | None:
        position, speed, _, voltage, temperature, registered, _, moving = BLOCK1.unpack(answer.status.data)
        if moving > 1 or registered > 1 or not self._is_possible(position) or not self._is_steady(voltage, temperature):
            return None
        velocity = (speed & NUMBER1) * self.servo.model.velocity_unit * (-1 if speed & SIGN1 else 1)
        alert = answer.status.error != 0
        timing = (self.request_key(answer), answer.earliest)
        return Sample(*timing, answer.earliest, answer.latest, position, velocity, None, bool(moving), alert)

    def _is_possible(self, position: int) -> bool:
        if self.servo.model.ticks_per_turn is None:
            return 0 <= position <= NUMBER1
        return abs(position) <= LARGEST_POSITION1


def read_methods_of(bus: ServoBus, servos: Sequence[IdentifiedServo], config: BusConfig) -> list[list[ReadMethod]]:
    """Return the read methods of each group: Protocol 1.0 as one, and each series of Protocol 2.0."""
    alone = [servo for servo in servos if servo.model.protocol == 1]
    series: dict[int, list[IdentifiedServo]] = {}
    for servo in servos:
        if servo.model.protocol == 2:
            series.setdefault(servo.model.layout.block.address, []).append(servo)
    groups = [[one_by_one(bus, alone)]] if alone else []
    for group in series.values():
        layout, ids = group[0].model.layout, [servo.id for servo in group]
        read_methods = [ReadMethod("Sync Read", (sync_request(layout, ids, fast=False),))]
        if len(ids) > 1 and config.fast_sync_read == "auto":
            read_methods.insert(0, ReadMethod("Fast Sync Read", (sync_request(layout, ids, fast=True),)))
        groups.append(read_methods)
    return groups


DYNAMIXEL = ServoVendor(
    DynamixelConfig.table, BY_NUMBER, HARDWARE_ERRORS, Bus, Channel, read_methods_of, settings_of, tick_s=TICK_S
)


class DynamixelJoints(ServoJoints):
    """An arm of Dynamixel servos as a `JointSource`; see `ServoJoints`."""

    vendor = DYNAMIXEL
