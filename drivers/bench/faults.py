"""Faults of an answer in transit. (Faults of a servo are set on the servo.)"""

from __future__ import annotations

from collections.abc import Mapping
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


class Planned:
    """Faults of chosen servos, each for a given number of answers."""

    def __init__(self, rng: Random | None = None) -> None:
        self._rng = Random(0) if rng is None else rng
        self._plan: dict[int, tuple[Fault, int | None]] = {}

    def add(self, id: int, fault: Fault, times: int | None = None) -> None:
        """Apply `fault` to the servo's next `times` answers; None: to all of them, until `clear`."""
        self._plan[id] = (fault, times)

    def clear(self) -> None:
        self._plan.clear()

    def __call__(self, reply: Reply) -> Reply:
        if reply.id not in self._plan:
            return reply
        fault, times = self._plan[reply.id]
        if times is not None:
            if times <= 1:
                del self._plan[reply.id]
            else:
                self._plan[reply.id] = (fault, times - 1)
        return fault(reply, self._rng)


class Storm:
    """Random faults."""

    def __init__(self, shares: Mapping[str, tuple[float, Fault]], rng: Random) -> None:
        """Start with all counts at zero.

        Args:
            shares: by name, the probability that an answer is affected, and the fault.
        """
        self._shares, self._rng = dict(shares), rng
        self._total = sum(share for share, _ in self._shares.values())
        self.struck = dict.fromkeys(self._shares, 0)

    def __call__(self, reply: Reply) -> Reply:
        drawn = self._rng.random()
        if drawn >= self._total:
            return reply
        for name, (share, fault) in self._shares.items():
            if drawn < share:
                self.struck[name] += 1
                return fault(reply, self._rng)
            drawn -= share
        return reply


def storm(intensity: float, rng: Random, *others: Fault, longest_late_s: float = 0.05) -> Storm:
    """Mix all faults and `others` in equal shares; `intensity` is the probability that an answer is affected."""
    faults = {
        "mute": mute,
        "late": late(longest_late_s),
        "wrong checksum": wrong_checksum,
        "corrupt": corrupt(),
        "half": half,
        "garbage": garbage,
        **{f"other {k}": fault for k, fault in enumerate(others, 1)},
    }
    return Storm({name: (intensity / len(faults), fault) for name, fault in faults.items()}, rng)
