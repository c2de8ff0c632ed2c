"""Count the sampler's frames, readings, pairs, rejections by reason, rates, and joint coverage."""

from __future__ import annotations

from collections import Counter, deque

from bodyschema.daemon.transport.status import JointRange
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray, Reason
from bodyschema.interfaces.rejections import REMEDIES, WORDS
from bodyschema.interfaces.waits import Waits
from bodyschema.robot.description import RobotDescription


class _Settings:
    # A complaint needs nearly all of the newest frames (10 s of a usual camera; fewer at the start) to be refused.
    newest_frames, min_frames, nearly_all = 300, 30, 0.9


# An arm at rest, or paused by an operator, is in order. The other reasons have complaints of their own.
_NO_COMPLAINT = frozenset({Reason.TOO_NEAR, Reason.PAUSED, Reason.NOT_STORED, Reason.NOT_BORNE})


class SamplerCounters:
    """Counters with one writer each, read from any thread.

    Attributes:
        readings, frames, pairs: since the start.
        frames_per_s, readings_per_s, pairs_per_s: over the last window of wall time.
    """

    def __init__(
        self, robot: RobotDescription, wall: Clock, covered: tuple[FloatArray, FloatArray] | None = None
    ) -> None:
        """Start all counters at zero.

        Args:
            covered: smallest and largest joint angles of the existing pairs.
        """
        self._robot, self._wall = robot, wall
        self._covered = covered
        # All reasons exist from the start, because a dict must not grow while another thread copies it.
        self._rejected = dict.fromkeys(Reason, 0)
        self._newest: deque[Reason | None] = deque(maxlen=_Settings.newest_frames)
        self.readings = self.frames = self.pairs = 0
        self.readings_per_s = self.frames_per_s = self.pairs_per_s = 0.0
        self._started = self._window_start = wall.now()
        self._window_counts = (0, 0, 0)

    @property
    def uptime_s(self) -> float:
        """Wall time since the start [s]."""
        return self._wall.now() - self._started

    @property
    def rejected(self) -> dict[str, int]:
        """Frames that did not become pairs, by reason."""
        return {reason.value: count for reason, count in self._rejected.items() if count}

    @property
    def coverage(self) -> dict[str, JointRange]:
        """Covered ranges by joint; empty before the first pair."""
        covered, robot = self._covered, self._robot
        if covered is None:
            return {}
        ranges = zip(robot.joints, covered[0], covered[1], robot.lower, robot.upper, strict=True)
        return {
            name: JointRange(float(low), float(high), float(lower), float(upper))
            for name, low, high, lower, upper in ranges
        }

    @property
    def complaints(self) -> list[str]:
        """Complaint with main reason and remedy if nearly no frame becomes a pair; otherwise empty."""
        newest = tuple(self._newest)
        refused = Counter(reason for reason in newest if reason is not None)
        if len(newest) < _Settings.min_frames or refused.total() < _Settings.nearly_all * len(newest):
            return []
        [(reason, count)] = refused.most_common(1)
        return [f"{count} of the last {len(newest)} frames were rejected: {WORDS[reason]}. {REMEDIES[reason]}"]

    def reject(self, reason: Reason) -> None:
        """Count a frame that did not become a pair."""
        self._rejected[reason] += 1
        self._newest.append(None if reason in _NO_COMPLAINT else reason)

    def accept(self, q: FloatArray) -> None:
        """Count a pair at the joint angles `q`, shape (d,)."""
        self.pairs += 1
        self._newest.append(None)
        low, high = self._covered or (q, q)
        self._covered = (q.clip(max=low), q.clip(min=high))

    def tick(self) -> None:
        """Update the rates at the end of a window."""
        now = self._wall.now()
        passed = now - self._window_start
        if passed < Waits.status_every_s:  # in a shorter window single frames would be visible
            return
        counts = (self.readings, self.frames, self.pairs)
        rates = [(count - before) / passed for count, before in zip(counts, self._window_counts, strict=True)]
        self.readings_per_s, self.frames_per_s, self.pairs_per_s = rates
        self._window_start, self._window_counts = now, counts
