"""Pair the images of two unsynchronised cameras by time."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from bodyschema.interfaces.records import ImageArray

KEPT = 4  # images of each camera; older ones are never paired


@dataclass(frozen=True, slots=True)
class Shot:
    """An image of one camera and its time."""

    t: float  # timestamp [s], latency not yet subtracted
    t_sigma: float  # 1-sigma of it [s]
    image: ImageArray  # (height, width, 3), uint8, BGR


class Pairing:
    """Matcher of each image of the lagging camera with the nearest of the other one; no image is used twice.

    An image of the lagging camera is bracketed by the other camera's images, so no later one can be nearer.

    Attributes:
        too_far: number of images without a partner near enough in time.
        gap_s: time between the last two candidates [s], near enough or not; None before the first.
    """

    def __init__(self, max_gap_s: float) -> None:
        self._max_gap_s = max_gap_s
        self._shots: tuple[deque[Shot], deque[Shot]] = (deque(maxlen=KEPT), deque(maxlen=KEPT))
        self._returned_t = [-math.inf, -math.inf]
        self._last_lagging_t = -math.inf
        self.too_far = 0
        self.gap_s: float | None = None

    def put(self, eye: int, shot: Shot) -> None:
        """Add the newest image of the left (0) or the right (1) eye."""
        self._shots[eye].append(shot)

    def take(self) -> tuple[Shot, Shot] | None:
        """Return the newest pair not returned before, or None."""
        if not all(self._shots):
            return None
        lagging = 0 if self._shots[0][-1].t <= self._shots[1][-1].t else 1
        shot = self._shots[lagging][-1]
        if shot.t <= max(self._last_lagging_t, self._returned_t[lagging]):
            return None
        unused = [candidate for candidate in self._shots[1 - lagging] if candidate.t > self._returned_t[1 - lagging]]
        if not unused:
            return None
        other = min(unused, key=lambda candidate: abs(candidate.t - shot.t))
        self._last_lagging_t, self.gap_s = shot.t, abs(other.t - shot.t)
        if self.gap_s > self._max_gap_s:
            self.too_far += 1
            return None
        left, right = (shot, other) if lagging == 0 else (other, shot)
        self._returned_t = [left.t, right.t]
        return left, right
