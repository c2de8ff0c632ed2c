"""Positions across turns, and whether a joint can have come to where it is said to be."""

from __future__ import annotations

import math
from collections.abc import Sequence


def nearest_turn(raw: int, near: float, per_turn: int | None) -> int:
    """`raw` plus whole turns, nearest to `near` [ticks]; `raw` itself where the sensor has no turns."""
    if per_turn is None:
        return raw
    return raw + per_turn * math.floor((near - raw) / per_turn + 0.5)


class SpeedGate:
    """Refuses places that no joint can have come to in the time since the last believed ones.

    A glitch is over with the next reading. Places that are refused, but agree with each other, tell that something
    has jumped (`jumped`).
    """

    CONFIRMATIONS = 5

    def __init__(self, fastest: Sequence[float], slack: Sequence[float]) -> None:
        """A gate that has seen nothing.

        Args:
            fastest: speed of each joint that is still believed [units/s].
            slack: how far each may be off besides [units].
        """
        self._fastest, self._slack = tuple(fastest), tuple(slack)
        self._believed: tuple[float, tuple[float, ...]] | None = None
        self._suspect: tuple[float, tuple[float, ...]] | None = None
        self._agreeing = 0

    @property
    def jumped(self) -> bool:
        """So many refused places in a row agreed with each other that they have to be true."""
        return self._agreeing >= self.CONFIRMATIONS

    def offer(self, t: float, places: Sequence[float]) -> int | None:
        """The first joint that cannot be there at `t` [s]; None when all can, which is then believed."""
        seen = (t, tuple(places))
        refused = self._implausible(self._believed, seen)
        if refused is None:
            self._believed, self._suspect, self._agreeing = seen, None, 0
            return None
        agrees = self._suspect is not None and self._implausible(self._suspect, seen) is None
        self._agreeing = self._agreeing + 1 if agrees else 1
        self._suspect = seen
        return refused

    def _implausible(
        self, before: tuple[float, tuple[float, ...]] | None, seen: tuple[float, tuple[float, ...]]
    ) -> int | None:
        if before is None:
            return None
        dt = abs(seen[0] - before[0])
        bounds = zip(before[1], seen[1], self._fastest, self._slack, strict=True)
        for joint, (was, now, fastest, slack) in enumerate(bounds):
            if abs(now - was) > fastest * dt + slack:
                return joint
        return None
