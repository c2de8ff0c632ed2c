"""Handle positions across turns, and check that a joint can have reached a reported position."""

from __future__ import annotations

import math
from collections.abc import Sequence

# No joint of an arm that a hand guides moves faster, turning or sliding: 3 to 10 times what arms reach by motor.
FASTEST_RAD_S, FASTEST_M_S = math.radians(600.0), 3.0


def nearest_turn(raw: int, near: float, per_turn: int | None) -> int:
    """Return `raw` plus whole turns, nearest to `near` [ticks]; `raw` itself for a sensor that does not wrap."""
    if per_turn is None:
        return raw
    return raw + per_turn * math.floor((near - raw) / per_turn + 0.5)


class SpeedGate:
    """Filter for positions that no joint can have reached in the time since the last accepted ones.

    A glitch ends with the next reading. Rejected positions that agree with each other show a real jump (`jumped`).
    """

    CONFIRMATIONS = 5

    def __init__(self, fastest: Sequence[float], slack: Sequence[float]) -> None:
        """Start without a reading.

        Args:
            fastest: highest plausible speed of each joint [units/s].
            slack: additional tolerance of each position [units].
        """
        self._fastest, self._slack = tuple(fastest), tuple(slack)
        self._accepted: tuple[float, tuple[float, ...]] | None = None
        self._suspect: tuple[float, tuple[float, ...]] | None = None
        self._agreeing = 0

    @property
    def jumped(self) -> bool:
        """True if enough consecutive rejected positions agreed with each other to be accepted as real."""
        return self._agreeing >= self.CONFIRMATIONS

    def offer(self, t: float, places: Sequence[float]) -> int | None:
        """Return the first joint that cannot be at its position at `t` [s].

        Otherwise accept the positions and return None.
        """
        seen = (t, tuple(places))
        rejected = self._implausible(self._accepted, seen)
        if rejected is None:
            self._accepted, self._suspect, self._agreeing = seen, None, 0
            return None
        agrees = self._suspect is not None and self._implausible(self._suspect, seen) is None
        self._agreeing = self._agreeing + 1 if agrees else 1
        self._suspect = seen
        return rejected

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
