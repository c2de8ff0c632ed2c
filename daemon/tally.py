"""What the sampler has counted: frames, readings, pairs, rejections by reason, rates, and coverage of the joints."""

from __future__ import annotations

from collections import Counter, deque

from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray, Reason
from bodyschema.interfaces.rejections import REMEDIES
from bodyschema.interfaces.robot import RobotDescription

from .status import JointRange

# Rates are taken over at least this long, so that single frames do not make them jump.
RATE_WINDOW_S = 1.0
# Of the newest frames, 10 s of a usual camera, nearly all have to be refused to be complained of; of the first, fewer.
NEWEST_FRAMES, FEWEST_FRAMES, NEARLY_ALL = 300, 30, 0.9
# An arm that stands still, or that an operator paused, is in order. The others have complaints of their own.
_NO_COMPLAINT = frozenset({Reason.TOO_NEAR, Reason.PAUSED, Reason.NOT_STORED, Reason.NOT_BORNE})


class Tally:
    """Counters with one writer each, read from any thread.

    Attributes:
        readings, frames, pairs: since the start.
        frames_per_s, readings_per_s, pairs_per_s: over the last window of wall time.
    """

    def __init__(
        self, robot: RobotDescription, wall: Clock, covered: tuple[FloatArray, FloatArray] | None = None
    ) -> None:
        """All at zero.

        Args:
            wall: the clock for rates.
            covered: smallest and largest joint angles of the pairs that are there already.
        """
        self._robot, self._wall = robot, wall
        self._covered = covered
        # Every reason is there from the start, because a dict must not grow while another thread copies it.
        self._rejected = dict.fromkeys(Reason, 0)
        self._newest: deque[Reason | None] = deque(maxlen=NEWEST_FRAMES)
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
        """By joint; empty before the first pair."""
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
        """That nearly no frame becomes a pair, mostly why, and what to do; nothing where that is not so."""
        newest = tuple(self._newest)
        refused = Counter(reason for reason in newest if reason is not None)
        if len(newest) < FEWEST_FRAMES or refused.total() < NEARLY_ALL * len(newest):
            return []
        [(reason, count)] = refused.most_common(1)
        name = reason.replace("_", " ")
        return [f"{count} of the last {len(newest)} frames were rejected: {name}. {REMEDIES[reason]}"]

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
        """Renew the rates when a window is over."""
        now = self._wall.now()
        passed = now - self._window_start
        if passed < RATE_WINDOW_S:
            return
        counts = (self.readings, self.frames, self.pairs)
        rates = [(count - before) / passed for count, before in zip(counts, self._window_counts, strict=True)]
        self.readings_per_s, self.frames_per_s, self.pairs_per_s = rates
        self._window_start, self._window_counts = now, counts
