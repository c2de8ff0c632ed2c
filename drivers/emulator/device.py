"""Interface of the emulated device behind a port."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Protocol

from bodyschema.drivers.echo import BITS_PER_BYTE


@dataclass(frozen=True, slots=True)
class Reply:
    """An answer in transit."""

    id: int  # ID of the sender (of the first one, for a common answer)
    start: float  # when its first byte is on the wire [s]
    data: bytes  # its bytes; empty when it is not sent


Angle = Callable[[float], float]
"""Angle [rad] as a function of time [s]."""
Fault = Callable[[Reply, Random], Reply]


Faults = Callable[[Reply], Reply]
"""Applies faults to each answer."""


def no_faults(reply: Reply) -> Reply:
    """Return the answer unchanged."""
    return reply


class Device(Protocol):
    """A device that answers instructions or sends on its own."""

    def send(self, data: bytes, t: float, baud: int) -> list[Reply]:
        """Send the host's `data`, whose first byte is on the wire at `t` [s], and return the answers in order."""
        ...

    @property
    def speaks_at(self) -> float:
        """Time of the next unsolicited transmission [s]; infinity if it sends nothing."""
        ...

    def speak(self, until: float, baud: int) -> list[Reply]:
        """Return the unsolicited transmissions that begin by `until` and have not been returned yet."""
        ...


class AnswerOnlyDevice:
    """A device that never sends on its own."""

    speaks_at = math.inf

    def speak(self, until: float, baud: int) -> list[Reply]:
        del until, baud
        return []


def byte_s(baud: int) -> float:
    """Return the duration of one byte [s]."""
    return BITS_PER_BYTE / baud


@dataclass(frozen=True, slots=True)
class Sampling:
    """Time [s] and shaft angle [rad] of a sampled position."""

    t: float
    angle: float
