"""Readings of all joints out of messages that tell of some each."""

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
        t: the time [s]; of a message, never between two.
        stamp_ns: that message's stamp.
        q: positions.
        gap_s: the longest time between the two messages that a joint's position was taken from.
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
    """Keeps what is known of each joint since the last reading.

    All joints are known up to the newest message of that one which was heard of least recently: that is the time of
    the next reading, and the others are interpolated to it.
    """

    def __init__(self, joints: int) -> None:
        """Nothing is known of so many joints."""
        self._tracks: list[deque[_Point]] = [deque(maxlen=LONGEST) for _ in range(joints)]
        self._told = float("-inf")

    def missing(self) -> list[int]:
        """The joints of which nothing has come."""
        return [place for place, track in enumerate(self._tracks) if not track]

    def put(self, t: float, sigma_s: float, stamp_ns: int, places: Sequence[int], q: Sequence[float]) -> Merged | None:
        """Take positions `q` of the joints at `places`; the reading that they complete."""
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
    """A joint's position at `t`, and how far apart in time the two are that it is taken from; drops what is older.

    None when it was not known yet.
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
