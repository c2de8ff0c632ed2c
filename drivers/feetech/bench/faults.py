"""Faults of a Feetech answer in transit; see `bodyschema.drivers.bench.faults`."""

from __future__ import annotations

from dataclasses import replace
from random import Random

from bodyschema.drivers.bench import faults
from bodyschema.drivers.bench.device import Reply


def swapped(reply: Reply, rng: Random) -> Reply:
    """Replace the ID by another one, with a matching checksum."""
    data = bytearray(reply.data)
    data[2] = (reply.id + rng.choice((-1, 1))) % 253
    data[-1] = ~sum(data[2:-1]) & 0xFF
    return replace(reply, data=bytes(data))


def storm(intensity: float, rng: Random, longest_late_s: float = 0.05) -> faults.Storm:
    """Mix all faults in equal shares; `intensity` is the probability that an answer is affected."""
    return faults.storm(intensity, rng, swapped, longest_late_s=longest_late_s)
