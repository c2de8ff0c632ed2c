"""Merge messages that each contain some of the joints into readings of all joints."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

LONGEST = 4096


@dataclass(frozen=True, slots=True)
class Merged:
    """All joints at one time.

    Attributes:
        t: the time of a message [s], never between two messages.
        stamp_ns: that message's stamp.
        q: positions.
        gap_s: the longest time between the two messages that a joint's position was interpolated from.
        sigma_s: the largest 1-sigma of their times.
    """

    t: float
    stamp_ns: int
    q: tuple[float, ...]
    gap_s: float
    sigma_s: float


@dataclass(frozen=True, slots=True)
class _Point:
    t: float
    sigma_s: float
    stamp_ns: int
    q: float


class Merging:
    """Buffer of the positions of each joint since the last reading.

    The next reading is at the time of the newest message of the joint that was updated least recently. The other joints
    are interpolated to this time.
    """

    def __init__(self, joints: int) -> None:
        """Start with empty buffers for `joints` joints."""
        self._tracks: list[deque[_Point]] = [deque(maxlen=LONGEST) for _ in range(joints)]
        self._told = float("-inf")

    def missing(self) -> list[int]:
        """Return the joints without any position so far."""
        return [place for place, track in enumerate(self._tracks) if not track]

    def put(self, t: float, sigma_s: float, stamp_ns: int, places: Sequence[int], q: Sequence[float]) -> Merged | None:
        """Add positions `q` of the joints at `places`; return the reading that they complete."""
        for place, value in zip(places, q, strict=True):
            track = self._tracks[place]
            if not track or t > track[-1].t:
                track.append(_Point(t, sigma_s, stamp_ns, value))
        if self.missing():
            return None
        slowest = min((track[-1] for track in self._tracks), key=lambda point: point.t)
        if slowest.t <= self._told:
            return None
        found = [_at(slowest.t, track) for track in self._tracks]
        if any(part is None for part in found):
            return None
        self._told = slowest.t
        parts = [part for part in found if part is not None]
        sigma_s = max(track[0].sigma_s for track in self._tracks)
        return Merged(slowest.t, slowest.stamp_ns, tuple(q for q, _ in parts), max(gap for _, gap in parts), sigma_s)


def _at(t: float, track: deque[_Point]) -> tuple[float, float] | None:
    """Return a joint's position at `t` and the time between the two it is interpolated from; drop older ones.

    Return None when it was not known yet at `t`.
    """
    while len(track) > 1 and track[1].t <= t:
        track.popleft()
    before = track[0]
    if before.t > t:
        return None
    if before.t == t:
        return before.q, 0.0
    after = next(islice(track, 1, 2))
    gap = after.t - before.t
    return before.q + (after.q - before.q) * (t - before.t) / gap, gap
