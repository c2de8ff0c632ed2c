"""Check that an answer is one servo's present position."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Protocol

from bodyschema.drivers.servos.servo import IdentifiedServo
from bodyschema.interfaces.records import JointReading

from .bus import Answer, Bus


class _Settings:
    # A position this far off the extrapolated one is requested again. Rounding of three positions alone makes two
    # ticks.
    surprise_rad: float = math.radians(0.35)
    surprise_ticks: float = 2.0
    # readings that define the usual uncertainty
    window: int = 51
    delay_slack_s: float = 0.3e-3
    # shortest interval between two samples for a speed
    shortest_s: float = 1e-3
    # largest plausible changes, which are slow: 0.1 V, K
    voltage_step: int = 15
    temperature_step: int = 3


@dataclass(frozen=True, slots=True)
class Sample:
    """A servo's decoded answer."""

    request_key: tuple[str, float]  # the bus, and the time of the request; the same for all answers to one request
    expected: float  # time of the sample if nothing was delayed [s]
    # earliest, latest: bounds of the time of the sample [s]
    earliest: float
    latest: float
    ticks: int  # position as reported
    velocity: float  # [rad/s], in the servo's own direction
    current: float | None  # [A], or None where it is not measured
    moving: bool  # the servo reports motion
    alert: bool  # the servo reports a fault; its position is valid nevertheless

    @property
    def middle(self) -> float:
        """Middle of the possible time of the sample [s]."""
        return (self.earliest + self.latest) / 2


class Channel(ABC):
    """The answers of one servo since the bus was opened."""

    def __init__(self, servo: IdentifiedServo) -> None:
        self.servo = servo
        self.newest: Sample | None = None  # the last accepted sample
        self.rejected_in_a_row = 0  # number of consecutive rejected answers
        self.is_unexpected = True  # the newest sample deviates from the trend of the two before it
        self._trend: tuple[float, float, float] | None = None
        self._speed = 0.0
        self._max_deviation = max(_Settings.surprise_rad / servo.model.rad_per_tick, _Settings.surprise_ticks)
        self._supply: tuple[int, int] | None = None

    def take(self, answer: Answer) -> Sample | None:
        """Decode an answer; return None when it cannot be from this servo at this time."""
        sample = self._sample(answer)
        if sample is None:
            self.rejected_in_a_row += 1
            return None
        self._compare(sample)
        self.newest, self.rejected_in_a_row = sample, 0
        return sample

    def request_key(self, answer: Answer) -> tuple[str, float]:
        """Return the key of the request that was answered."""
        return self.servo.bus, answer.request_t

    @abstractmethod
    def _sample(self, answer: Answer) -> Sample | None:
        """Decode an answer; return None if it is implausible."""

    def agrees(self, first: Sample, second: Sample) -> bool:
        """Return True if the joint's motion between two samples matches its earlier speed.

        A joint that just begins to move has moved by too few ticks to tell. A wrong answer deviates by more, since it
        was surprising.
        """
        moved = self._speed * (second.middle - first.middle)
        return abs(self._step(second.ticks - first.ticks) - moved) <= self._max_deviation

    def _compare(self, sample: Sample) -> None:
        """Update the trend, and note if the sample deviates from it."""
        t = sample.middle
        if self._trend is None:
            self._trend = (t, sample.ticks, 0.0)
            return
        before_t, before, speed = self._trend
        if not self.is_unexpected:
            self._speed = speed
        moved = self._step(sample.ticks - before)
        self.is_unexpected = abs(moved - speed * (t - before_t)) > self._max_deviation
        self._trend = (t, sample.ticks, moved / max(t - before_t, _Settings.shortest_s))

    def _step(self, ticks: float) -> float:
        turn = self.servo.model.ticks_per_turn
        return ticks if turn is None else (ticks + turn / 2) % turn - turn / 2

    def _is_steady(self, voltage: int, temperature: int) -> bool:
        before = self._supply
        if before is not None and (
            abs(voltage - before[0]) > _Settings.voltage_step
            or abs(temperature - before[1]) > _Settings.temperature_step
        ):
            return False
        self._supply = (voltage, temperature)
        return True


def middle(samples: Sequence[Sample]) -> tuple[float, float]:
    """Return the middle of the time in which the positions were taken [s], and its largest possible error [s].

    The servos answer in the pace of the wire, so the answers to one request can only be delayed together: one delay,
    within the bounds of all, shifts them all. Each request has its own delay.
    """
    total = uncertainty_s = 0.0
    for request_key in {sample.request_key for sample in samples}:
        group = [sample for sample in samples if sample.request_key == request_key]
        min_delay = max(sample.earliest - sample.expected for sample in group)
        max_delay = min(sample.latest - sample.expected for sample in group)
        if min_delay <= max_delay:
            total += sum(sample.expected for sample in group) + len(group) * (min_delay + max_delay) / 2
            uncertainty_s += len(group) * (max_delay - min_delay) / 2
        else:
            total += sum(sample.earliest + sample.latest for sample in group) / 2
            uncertainty_s += sum(sample.latest - sample.earliest for sample in group) / 2
    return total / len(samples), uncertainty_s / len(samples)


class Punctuality:
    """Detector of readings that were delayed so much that their time is less certain than usual."""

    def __init__(self) -> None:
        self._uncertainties: deque[float] = deque(maxlen=_Settings.window)

    def is_usual(self, uncertainty_s: float) -> bool:
        """Return True if a reading's time is about as certain as usual, and include it in the median."""
        self._uncertainties.append(uncertainty_s)
        usual = median(self._uncertainties)
        return uncertainty_s <= max(usual + _Settings.delay_slack_s, 2 * usual)


class TorqueController(Protocol):
    """A component that moves or releases joints of an arm. Called by the reading thread, except `complaints`.

    Torque is off when it is opened. A servo fault never raises an exception: the joints are released.
    """

    @property
    def holding(self) -> frozenset[str]:
        """Joints whose torque may be on now."""
        ...

    @property
    def complaints(self) -> tuple[str, ...]:
        """Current problems, with the remedy; from any thread."""
        ...

    def open(self, buses: Mapping[str, Bus], servos: Sequence[IdentifiedServo]) -> None:
        """Accept the servos that were found, with torque verified off, in the order of the joints."""

    def step(self, reading: JointReading | None, samples: Mapping[str, Sample | None]) -> str | None:
        """Run once each cycle, after the request, with the reading (None when it was rejected) and the newest samples.

        Return why the joints had to be released in this cycle, so that the other drives release theirs too; else None.
        """

    def release(self, why: str | None) -> None:
        """Switch torque off and verify it on every joint as far as the bus allows. `why` is None at the regular end."""
