"""Decode and check the position that a Dynamixel servo reports."""

from __future__ import annotations

import struct

from bodyschema.drivers.device_clock import DeviceClock
from bodyschema.drivers.servos.bus import Answer
from bodyschema.drivers.servos.channel import Channel as ServoChannel
from bodyschema.drivers.servos.channel import Sample
from bodyschema.drivers.servos.handshake import FittedServo

from .models import TICK_S, TICKS
from .packets import ALERT

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
