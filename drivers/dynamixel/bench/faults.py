"""Faults of a Dynamixel answer in transit; see `bodyschema.drivers.bench.faults`."""

from __future__ import annotations

from dataclasses import replace
from random import Random

from bodyschema.drivers.bench import faults
from bodyschema.drivers.bench.device import Reply
from bodyschema.drivers.bench.faults import Storm
from bodyschema.drivers.dynamixel.crc16 import crc16

from .frames import HEADER2


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


def storm(intensity: float, rng: Random, longest_late_s: float = 0.05) -> Storm:
    """Mix all faults in equal shares; `intensity` is the probability that an answer is affected."""
    return faults.storm(intensity, rng, swapped, longest_late_s=longest_late_s)
