"""One servo's answers, judged: is this its position, of now?"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from .bus import Answer
from .handshake import FittedServo

# A position this far off its course is asked for again: rounding alone, of three positions, makes two ticks.
SURPRISE_RAD, SURPRISE_TICKS = math.radians(0.35), 2.0
LATELY = 51  # readings that tell what is usual
HELD_UP_S = 0.3e-3
SHORTEST_S = 1e-3  # between two samples that make a trend
VOLTAGE_STEP, TEMPERATURE_STEP = 15, 3  # these change slowly: 0.1 V, K


@dataclass(frozen=True, slots=True)
class Sample:
    """What a servo told.

    Attributes:
        question: the bus, and when it was asked there [s]; answers to one question have the same.
        expected: when it was so if nothing was held up [s].
        earliest, latest: between these times it was so [s].
        ticks: its position as it tells it.
        velocity: [rad/s], counted as the servo counts.
        current: [A], or None where it is not measured.
        alert: something is wrong with the servo; the position is right nevertheless.
    """

    question: tuple[str, float]
    expected: float
    earliest: float
    latest: float
    ticks: int
    velocity: float
    current: float | None
    moving: bool
    alert: bool

    @property
    def middle(self) -> float:
        """The middle of the time in which it was so [s]."""
        return (self.earliest + self.latest) / 2


class Channel(ABC):
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
        self._speed = 0.0
        self._off_course = max(SURPRISE_RAD / servo.model.rad_per_tick, SURPRISE_TICKS)
        self._supply: tuple[int, int] | None = None

    def take(self, answer: Answer) -> Sample | None:
        """What the answer says; None when it cannot be what this servo tells at this time."""
        sample = self._sample(answer)
        if sample is None:
            self.doubts += 1
            return None
        self._compare(sample)
        self.newest, self.doubts = sample, 0
        return sample

    def question(self, answer: Answer) -> tuple[str, float]:
        """Return to which question it answers."""
        return self.servo.bus, answer.asked

    @abstractmethod
    def _sample(self, answer: Answer) -> Sample | None:
        """What the answer says, if that is possible."""

    def agrees(self, first: Sample, second: Sample) -> bool:
        """Whether a joint goes from one sample to the next as fast as it moved before both.

        A joint that is only then set going has gone on by too few ticks to tell; a wrong answer is off by more, as
        it surprised.
        """
        moved = self._speed * (second.middle - first.middle)
        return abs(self._step(second.ticks - first.ticks) - moved) <= self._off_course

    def _compare(self, sample: Sample) -> None:
        """Whether it goes on from where the last ones led: time, ticks and ticks per second of them."""
        t = sample.middle
        if self._trend is None:
            self._trend = (t, sample.ticks, 0.0)
            return
        before_t, before, speed = self._trend
        if not self.surprising:
            self._speed = speed
        moved = self._step(sample.ticks - before)
        self.surprising = abs(moved - speed * (t - before_t)) > self._off_course
        self._trend = (t, sample.ticks, moved / max(t - before_t, SHORTEST_S))

    def _step(self, ticks: float) -> float:
        turn = self.servo.model.ticks_per_turn
        return ticks if turn is None else (ticks + turn / 2) % turn - turn / 2

    def _is_steady(self, voltage: int, temperature: int) -> bool:
        before = self._supply
        if before is not None and (
            abs(voltage - before[0]) > VOLTAGE_STEP or abs(temperature - before[1]) > TEMPERATURE_STEP
        ):
            return False
        self._supply = (voltage, temperature)
        return True


def middle(samples: Sequence[Sample]) -> tuple[float, float]:
    """The middle of the time in which the positions were taken [s], and by how much it may be wrong at most [s].

    Of those who answer to one question only this can have been held up: the servos answer as the wire goes on. So one
    delay, which is in the bounds of all, moves them all. Each question has a delay of its own.
    """
    total = unsure = 0.0
    for question in {sample.question for sample in samples}:
        there = [sample for sample in samples if sample.question == question]
        least = max(sample.earliest - sample.expected for sample in there)
        most = min(sample.latest - sample.expected for sample in there)
        if least <= most:
            total += sum(sample.expected for sample in there) + len(there) * (least + most) / 2
            unsure += len(there) * (most - least) / 2
        else:
            total += sum(sample.earliest + sample.latest for sample in there) / 2
            unsure += sum(sample.latest - sample.earliest for sample in there) / 2
    return total / len(samples), unsure / len(samples)


class Punctuality:
    """Tells readings that were held up so long that their time is not known as well as that of most."""

    def __init__(self) -> None:
        """No reading yet."""
        self._unsure: deque[float] = deque(maxlen=LATELY)

    def is_usual(self, unsure: float) -> bool:
        """Whether a reading's time is known about as well as usual, which this one takes part in."""
        self._unsure.append(unsure)
        usual = median(self._unsure)
        return unsure <= max(usual + HELD_UP_S, 2 * usual)
