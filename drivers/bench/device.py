"""What is behind a bench's port."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Protocol

BITS_PER_BYTE = 10  # with start and stop bit


@dataclass(frozen=True, slots=True)
class Reply:
    """Something that is said, on its way.

    Attributes:
        id: who says it (the first one of a common answer).
        start: when its first byte is on the wire [s].
        data: its bytes; none when it is not sent.
    """

    id: int
    start: float
    data: bytes


Fault = Callable[[Reply, Random], Reply]


class Faults(Protocol):
    """Decides what happens to each answer."""

    def __call__(self, reply: Reply) -> Reply: ...


def no_faults(reply: Reply) -> Reply:
    """Everything arrives."""
    return reply


class Device(Protocol):
    """Answers, or talks of itself."""

    def send(self, data: bytes, t: float, baud: int) -> list[Reply]:
        """The host's `data`, whose first byte is on the wire at `t` [s]; what is answered, in its order."""
        ...

    @property
    def speaks_at(self) -> float:
        """When it says something of itself next [s]; never, infinity."""
        ...

    def speak(self, until: float, baud: int) -> list[Reply]:
        """What it begins to say of itself by `until`, but has not said yet."""
        ...


class OnlyAnswers:
    """A device that says nothing of itself."""

    @property
    def speaks_at(self) -> float:
        """Never."""
        return math.inf

    def speak(self, until: float, baud: int) -> list[Reply]:
        """Nothing."""
        del until, baud
        return []


def byte_s(baud: int) -> float:
    """How long a byte takes [s]."""
    return BITS_PER_BYTE / baud


@dataclass(frozen=True, slots=True)
class Sampling:
    """When a position was taken that was told, and the shaft's angle then [rad]."""

    t: float
    angle: float
