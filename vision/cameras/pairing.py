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
        apart_s: time between the last two candidates [s], near enough or not; None before the first.
    """

    def __init__(self, longest_apart_s: float) -> None:
        self._longest_apart_s = longest_apart_s
        self._shots: tuple[deque[Shot], deque[Shot]] = (deque(maxlen=KEPT), deque(maxlen=KEPT))
        self._given = [-math.inf, -math.inf]
        self._tried = -math.inf
        self.too_far = 0
        self.apart_s: float | None = None

    def put(self, eye: int, shot: Shot) -> None:
        """Add the newest image of the left (0) or the right (1) eye."""
        self._shots[eye].append(shot)

    def take(self) -> tuple[Shot, Shot] | None:
        """Return the newest pair not returned before, or None."""
        if not all(self._shots):
            return None
        lagging = 0 if self._shots[0][-1].t <= self._shots[1][-1].t else 1
        shot = self._shots[lagging][-1]
        if shot.t <= max(self._tried, self._given[lagging]):
            return None
        left_over = [candidate for candidate in self._shots[1 - lagging] if candidate.t > self._given[1 - lagging]]
        if not left_over:
            return None
        other = min(left_over, key=lambda candidate: abs(candidate.t - shot.t))
        self._tried, self.apart_s = shot.t, abs(other.t - shot.t)
        if self.apart_s > self._longest_apart_s:
            self.too_far += 1
            return None
        left, right = (shot, other) if lagging == 0 else (other, shot)
        self._given = [left.t, right.t]
        return left, right
