"""Faults of answers in transit: planned for chosen servos, or random ones of all kinds."""

from __future__ import annotations

from collections.abc import Mapping
from random import Random

from bodyschema.drivers.emulator.device import Fault, Reply
from bodyschema.drivers.emulator.faults import corrupt, garbage, half, late, mute, wrong_checksum


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
