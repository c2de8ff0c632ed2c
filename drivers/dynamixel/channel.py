"""One servo's answers, judged: is this its position, of now?"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.device_clock import DeviceClock

from .bus import Answer
from .handshake import FittedServo
from .models import TICK_S, TICKS
from .packets import ALERT

BLOCK2 = struct.Struct("<HBBhhii")  # tick, moving, moving status, PWM, current, velocity, position
BLOCK1 = struct.Struct("<hHHBBBBB")  # position, speed, load, voltage, temperature, registered, reserved, moving
LARGEST_PWM = 2009  # of the P series; the others have less
SIGN1, NUMBER1 = 0x400, 0x3FF  # sign and magnitude of Protocol 1.0
LARGEST_POSITION1 = 28_672  # in multi-turn mode
SURPRISE_TICKS = 4
VOLTAGE_STEP, TEMPERATURE_STEP = 15, 3  # these change slowly: 0.1 V, K


@dataclass(frozen=True, slots=True)
class Sample:
    """What a servo told.

    Attributes:
        bus: which way it came.
        expected: when it was so if nothing was held up [s].
        earliest, latest: between these times it was so [s].
        ticks: its position as it tells it.
        velocity: [rad/s], counted as the servo counts.
        current: [A], or None where it is not measured.
        alert: something is wrong with the servo; the position is right nevertheless.
    """

    bus: str
    expected: float
    earliest: float
    latest: float
    ticks: int
    velocity: float
    current: float | None
    moving: bool
    alert: bool


class Channel:
    """The answers of one servo since the bus was opened.

    Attributes:
        servo: who it is.
        newest: the last sample that was believed.
        doubts: how many in a row were not.
        surprising: the newest is not where the two before it led to.
    """

    def __init__(self, servo: FittedServo) -> None:
        """Nothing was answered yet."""
        self.servo = servo
        self.newest: Sample | None = None
        self.doubts = 0
        self.surprising = True
        self._trend: tuple[float, float, float] | None = None
        self._clock = DeviceClock(TICK_S, TICKS)
        self._supply: tuple[int, int] | None = None

    def take(self, answer: Answer) -> Sample | None:
        """What the answer says; None when it cannot be what this servo tells at this time."""
        two = self.servo.model.protocol == 2
        sample = self._of_protocol2(answer) if two else self._of_protocol1(answer)
        if sample is None:
            self.doubts += 1
            return None
        self._compare(sample)
        self.newest, self.doubts = sample, 0
        return sample

    def agrees(self, first: Sample, second: Sample, speed: float) -> bool:
        """Whether a joint of at most `speed` [rad/s] can have told both."""
        ticks = speed * abs(second.latest - first.earliest) / self.servo.model.rad_per_tick
        return abs(self._step(second.ticks - first.ticks)) <= ticks + SURPRISE_TICKS

    def _compare(self, sample: Sample) -> None:
        """Whether it goes on from where the last ones led: time, ticks and ticks per second of them."""
        t = (sample.earliest + sample.latest) / 2
        if self._trend is None:
            self._trend = (t, sample.ticks, 0.0)
            return
        before_t, before, speed = self._trend
        moved = self._step(sample.ticks - before)
        self.surprising = abs(moved - speed * (t - before_t)) > SURPRISE_TICKS
        self._trend = (t, sample.ticks, moved / max(t - before_t, TICK_S))

    def _step(self, ticks: float) -> float:
        turn = self.servo.model.ticks_per_turn
        return ticks if turn is None else (ticks + turn / 2) % turn - turn / 2

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
        way = (self.servo.bus, answer.earliest)
        return Sample(*way, *between, position, velocity * model.velocity_unit, amperes, bool(moving), alert)

    def _of_protocol1(self, answer: Answer) -> Sample | None:
        position, speed, _, voltage, temperature, registered, _, moving = BLOCK1.unpack(answer.status.data)
        if moving > 1 or registered > 1 or not self._is_possible(position) or not self._is_steady(voltage, temperature):
            return None
        velocity = (speed & NUMBER1) * self.servo.model.velocity_unit * (-1 if speed & SIGN1 else 1)
        alert = answer.status.error != 0
        way = (self.servo.bus, answer.earliest)
        return Sample(*way, answer.earliest, answer.latest, position, velocity, None, bool(moving), alert)

    def _is_possible(self, position: int) -> bool:
        if self.servo.model.ticks_per_turn is None:
            return 0 <= position <= NUMBER1
        return abs(position) <= LARGEST_POSITION1

    def _is_steady(self, voltage: int, temperature: int) -> bool:
        before = self._supply
        if before is not None and (
            abs(voltage - before[0]) > VOLTAGE_STEP or abs(temperature - before[1]) > TEMPERATURE_STEP
        ):
            return False
        self._supply = (voltage, temperature)
        return True


def middle(samples: Sequence[Sample]) -> float:
    """The middle of the time in which the positions were taken [s].

    On one bus only the question can have been held up: the servos answer as the wire goes on. So one delay, which is in
    the bounds of all, moves them all.
    """
    total = 0.0
    for bus in {sample.bus for sample in samples}:
        there = [sample for sample in samples if sample.bus == bus]
        least = max(sample.earliest - sample.expected for sample in there)
        most = min(sample.latest - sample.expected for sample in there)
        if least <= most:
            total += sum(sample.expected for sample in there) + len(there) * (least + most) / 2
        else:
            total += sum(sample.earliest + sample.latest for sample in there) / 2
    return total / len(samples)
