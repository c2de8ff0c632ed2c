"""Joint angles at the time of a frame."""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from threading import Condition

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray, JointReading, Reason, frozen_array

CAPACITY = 8192
ROUNDING_S = 1e-9  # times of day-long clocks, subtracted


def joint_difference(q: FloatArray, other: FloatArray, prismatic: NDArray[np.bool_]) -> FloatArray:
    """`q` − `other`, shape (d,) [rad or m]; a revolute joint counts the shorter way round, as encoders wrap at ±π."""
    difference = q - other
    return np.where(prismatic, difference, np.remainder(difference + np.pi, 2 * np.pi) - np.pi)


class JointBuffer:
    """Recent joint readings, put in by the encoders' thread and asked for by the frames' thread.

    Both sides come in strictly increasing time. Readings before the frame that was asked for last are forgotten.
    When the buffer is full `put` waits for room, because a recording can be read faster than its frames are stored;
    of live encoders it forgets the oldest, because who reads them may bear the arm and can wait for nobody.

    Attributes:
        max_gap_s: readings around a frame may be this far apart [s].
    """

    def __init__(
        self,
        prismatic: NDArray[np.bool_],
        max_gap_s: float,
        capacity: int = CAPACITY,
        *,
        live: bool = False,
        kept_s: float = 0.0,
    ) -> None:
        """An empty buffer.

        Args:
            prismatic: which joints are prismatic, shape (d,).
            max_gap_s: readings around a frame may be this far apart [s].
            capacity: number of readings that are kept at most.
            live: `put` never waits.
            kept_s: readings of so long before the frame are not forgotten yet [s].
        """
        self._prismatic = prismatic
        self.max_gap_s = max_gap_s
        self._capacity = capacity
        self._live, self._kept_s = live, kept_s
        self._readings: deque[JointReading] = deque(maxlen=capacity if live else None)
        self._changed = Condition()
        self._expecting = True
        self._closed = False

    def put(self, reading: JointReading) -> None:
        """Add the newest reading; waits while the buffer is full and not live, does nothing once it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._live or len(self._readings) < self._capacity)
            if self._closed:
                return
            self._readings.append(reading)
            self._expecting = True
            self._changed.notify_all()

    def silence(self) -> None:
        """No reading is to be expected for now: the encoders are lost or through. The next `put` ends the silence."""
        with self._changed:
            self._expecting = False
            self._changed.notify_all()

    def forget_before(self, t: float) -> None:
        """No frame before `t` will be asked for: keep the last reading `kept_s` before it, and what follows."""
        with self._changed:
            self._forget_before(t)

    def make_room(self) -> None:
        """Forget the older half of a full buffer: no frame has come for so long that none will ask for it."""
        with self._changed:
            if len(self._readings) >= self._capacity:
                for _ in range(self._capacity // 2):
                    self._readings.popleft()
                self._changed.notify_all()

    def close(self) -> None:
        """Let go of everybody who waits."""
        with self._changed:
            self._closed = True
            self._expecting = False
            self._changed.notify_all()

    def at(self, t: float, timeout_s: float) -> FloatArray | Reason:
        """Joint angles at time `t`, shape (d,), interpolated linearly between the readings around it.

        Waits up to `timeout_s` for a reading at or after `t`. NO_JOINTS when there is none on one side of `t`,
        STALE when the two are farther apart than `max_gap_s`.
        """
        self.forget_before(t)
        with self._changed:
            self._changed.wait_for(lambda: not self._expecting or self._reaches(t), timeout_s)
            self._forget_before(t)
            if not self._reaches(t) or self._readings[0].t > t:
                return Reason.NO_JOINTS
            before, after = self._around(t)
        if before.t == t:
            return before.q
        if after.t - before.t > self.max_gap_s + ROUNDING_S:
            return Reason.STALE
        fraction = (t - before.t) / (after.t - before.t)
        return frozen_array(before.q + fraction * joint_difference(after.q, before.q, self._prismatic))

    def slack(self, t: float) -> FloatArray:
        """How far the joints move while the times of the readings around `t` are uncertain, shape (d,) [rad or m].

        For a `t` at which `at` gave angles.
        """
        with self._changed:
            before, after = self._around(t)
        sigma_s, apart_s = max(before.t_sigma, after.t_sigma), max(after.t - before.t, ROUNDING_S)
        return frozen_array(sigma_s / apart_s * joint_difference(after.q, before.q, self._prismatic))

    def moved(self, t: float, during_s: float, timeout_s: float) -> FloatArray | Reason:
        """How far the joints move within `during_s` of time `t`, shape (d,) [rad or m]; a reason as of `at`.

        The mean over both sides, so that a step of an encoder counts half. Where `during_s` is longer than `kept_s`,
        by the speed within that.
        """
        span_s = min(during_s, self._kept_s)
        before = self.at(t - span_s, timeout_s)
        if isinstance(before, Reason):
            return before
        after = self.at(t + span_s, timeout_s)
        if isinstance(after, Reason):
            return after
        return frozen_array(0.5 * during_s / span_s * joint_difference(after, before, self._prismatic))

    def _reaches(self, t: float) -> bool:
        return bool(self._readings) and self._readings[-1].t >= t

    def _forget_before(self, t: float) -> None:
        while len(self._readings) > 1 and self._readings[1].t <= t - self._kept_s:
            self._readings.popleft()
        self._changed.notify_all()

    def _around(self, t: float) -> tuple[JointReading, JointReading]:
        """The last reading at or before `t`, and the one after it."""
        for before, after in pairwise(self._readings):
            if after.t > t:
                return before, after
        return self._readings[-1], self._readings[-1]
