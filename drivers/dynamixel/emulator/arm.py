"""Emulate the Dynamixel servos of a robot.toml."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from random import Random

from bodyschema.drivers.dynamixel.config import DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.crc16 import crc16
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.frames import HEADER2
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.models import baud_value
from bodyschema.drivers.emulator.device import Angle, Faults, Reply
from bodyschema.drivers.emulator.faults import ON_THE_WIRE, FaultKinds
from bodyschema.drivers.emulator.servo_arm import AT_THE_START, ServoArm


class _Settings:
    fastest_rad_s: float = math.radians(180.0)  # about what a servo of the X series does without a load
    moves_kept: int = 1024  # about a second, at the rate at which a driver reads


class DrivenShaft:
    """The angle of a servo's shaft, which follows its servo's goal, and stays where it is without torque."""

    def __init__(self, angle: float, fastest_rad_s: float = _Settings.fastest_rad_s) -> None:
        """Start at `angle` [rad], 0 in the middle of the servo's range."""
        self.servo: Servo | None = None  # the servo that turns it, if any
        self.jammed = False  # the shaft does not move, whatever the servo does
        self._fastest = fastest_rad_s
        self._moves = deque([(-math.inf, angle)], maxlen=_Settings.moves_kept)
        self._lock = threading.RLock()  # its servo moves it in one thread, cameras see it in others

    def __call__(self, t: float) -> float:
        """Return the angle [rad] at `t` [s], now or as far back as it is stored."""
        with self._lock:
            return self._at(t)

    def turn_by_hand(self, angle: float) -> None:
        """Turn the shaft by `angle` [rad], as by hand."""
        with self._lock:
            moved_s, before = self._moves[-1]
            self._moves.append((moved_s, before + angle))

    def _at(self, t: float) -> float:
        moved_s, angle = self._moves[-1]
        if t <= moved_s:
            return self._before(t)
        self._moves.append((t, angle))  # a servo that stops asks for its present angle
        goal = None if self.servo is None or self.jammed else self.servo.held_at(t)
        if goal is not None and math.isfinite(moved_s):
            most = self._fastest * (t - moved_s)
            angle += min(max(goal - angle, -most), most)
            self._moves[-1] = (t, angle)
        return angle

    def _before(self, t: float) -> float:
        after: tuple[float, float] | None = None
        for before in reversed(self._moves):  # most requests are for a recent time
            if before[0] > t:
                after = before
                continue
            if after is None or not math.isfinite(before[0]):
                return before[1]
            return before[1] + (after[1] - before[1]) * (t - before[0]) / (after[0] - before[0])
        return self._moves[0][1]


def swapped(reply: Reply, rng: Random) -> Reply:
    """Replace the ID by another one, with a matching checksum."""
    other = (reply.id + rng.choice((-1, 1))) % 253
    data = bytearray(reply.data)
    if data[:4] == HEADER2:
        data[4] = other
        data[-2:] = crc16(data[:-2]).to_bytes(2, "little")
    else:
        data[2] = other
        data[-1] = ~sum(data[2:-1]) & 0xFF
    return replace(reply, data=bytes(data))


# Bits of Hardware Error Status.
ERRORS = {"voltage": 0x01, "hot": 0x04, "encoder": 0x08, "shock": 0x10, "overload": 0x20}
KINDS = FaultKinds({**ON_THE_WIRE, "swapped": swapped}, (*ERRORS, *AT_THE_START, "glitch"))
OTHER_BAUD = {57600: 1_000_000}  # any other rate: 57600


class DynamixelArm(ServoArm[Servo, DynamixelConfig]):
    """Dynamixel servos as configured; see `ServoArm`.

    Joints of the gaze begin at their start position and follow their servos.
    """

    kinds, errors = KINDS, ERRORS

    def _servo(self, entry: ServoConfig, angle: Angle) -> Servo:
        baud = self._config.buses[self._config.bus_of(entry)].baud
        booted_s = self._now() - self._rng.uniform(1, 9)
        model, delay_s = self._config.model_of(entry), self._return_delay_s
        gaze = self._config.gaze
        driven = DrivenShaft(angle(self._now())) if gaze is not None and entry.joint in gaze.joints else None
        servo = Servo(model, entry.id, driven or angle, baud=baud, return_delay_s=delay_s, booted_s=booted_s)
        if driven is not None:
            driven.servo = servo
        return servo

    def _chain(self, servos: Sequence[Servo], faults: Faults) -> Chain:
        return Chain(servos, faults)

    def _begin(self, kind: str, joint: str) -> None:
        servo = self.servo(joint)
        if kind == "torque":
            servo["goal"] = servo.position(self._now())  # it holds its present position
        super()._begin(kind, joint)

    def _change_rate(self, servo: Servo) -> None:
        servo["baud"] = baud_value(servo.model.layout, OTHER_BAUD.get(servo.baud, 57600))
