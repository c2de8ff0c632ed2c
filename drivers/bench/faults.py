"""Faults of an answer in transit. (Faults of a servo are set on the servo.)"""

from __future__ import annotations

from dataclasses import replace
from random import Random

from .device import Fault, Reply


def mute(reply: Reply, rng: Random) -> Reply:
    """Drop the answer."""
    del rng
    return replace(reply, data=b"")


def late(longest_s: float) -> Fault:
    """Return a fault that delays an answer by up to `longest_s`."""
    return lambda reply, rng: replace(reply, start=reply.start + rng.uniform(0.0, longest_s))


def wrong_checksum(reply: Reply, rng: Random) -> Reply:
    """Flip one bit of the checksum."""
    return replace(reply, data=reply.data[:-1] + bytes((reply.data[-1] ^ 1 << rng.randrange(8),)))


def corrupt(most_bytes: int = 4) -> Fault:
    """Return a fault that changes up to `most_bytes` bytes."""

    def fault(reply: Reply, rng: Random) -> Reply:
        data = bytearray(reply.data)
        for _ in range(rng.randint(1, most_bytes)):
            data[rng.randrange(len(data))] ^= rng.randint(1, 255)
        return replace(reply, data=bytes(data))

    return fault


def half(reply: Reply, rng: Random) -> Reply:
    """Truncate the answer."""
    return replace(reply, data=reply.data[: rng.randrange(1, len(reply.data))])


def garbage(reply: Reply, rng: Random) -> Reply:
    """Put up to twelve random bytes before or after the answer."""
    noise = rng.randbytes(rng.randint(1, 12))
    return replace(reply, data=noise + reply.data if rng.random() < 0.5 else reply.data + noise)
