"""A shaft that its servo turns, as the joints of a head are."""

from __future__ import annotations

import math
import threading
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .servo import Servo

FASTEST_RAD_S = math.radians(180.0)  # about what a servo of the X series does without a load
KEPT = 1024  # moves that are remembered: about a second, at the rate at which a driver reads


class DrivenShaft:
    """The angle of a servo's shaft: it goes where the servo holds it, and stays where nothing does.

    Attributes:
        servo: the servo that turns it, if any.
        jammed: the shaft does not move, whatever the servo does.
    """

    def __init__(self, angle: float, fastest_rad_s: float = FASTEST_RAD_S) -> None:
        """Start at `angle` [rad], 0 in the middle of the servo's range."""
        self.servo: Servo | None = None
        self.jammed = False
        self._fastest = fastest_rad_s
        self._moves = deque([(-math.inf, angle)], maxlen=KEPT)
        self._lock = threading.RLock()  # its servo moves it in one thread, cameras see it in others

    def __call__(self, t: float) -> float:
        """Return the angle [rad] at `t` [s], now or as far back as it is stored."""
        with self._lock:
            return self._at(t)

    def turn_by_hand(self, angle: float) -> None:
        """Turn the shaft by `angle` [rad], as by hand."""
        with self._lock:
            moved_s, before = self._moves[-1]
            self._moves.append((moved_s, before + angle))

    def _at(self, t: float) -> float:
        moved_s, angle = self._moves[-1]
        if t <= moved_s:
            return self._before(t)
        self._moves.append((t, angle))  # a servo that stops asks where it is
        goal = None if self.servo is None or self.jammed else self.servo.held_at(t)
        if goal is not None and math.isfinite(moved_s):
            most = self._fastest * (t - moved_s)
            angle += min(max(goal - angle, -most), most)
            self._moves[-1] = (t, angle)
        return angle

    def _before(self, t: float) -> float:
        after: tuple[float, float] | None = None
        for before in reversed(self._moves):  # what is asked for is most often not long ago
            if before[0] > t:
                after = before
                continue
            if after is None or not math.isfinite(before[0]):
                return before[1]
            return before[1] + (after[1] - before[1]) * (t - before[0]) / (after[0] - before[0])
        return self._moves[0][1]
