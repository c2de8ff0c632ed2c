"""Interpolate joint angles at the time of a frame."""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from threading import Condition

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray, JointReading, Reason, frozen_array

ROUNDING_S = 1e-9  # rounding error of time differences on day-long clocks


def joint_difference(q: FloatArray, other: FloatArray, prismatic: NDArray[np.bool_]) -> FloatArray:
    """Return `q` − `other`, shape (d,) [rad or m]; revolute joints go the shorter way round: encoders wrap at ±π."""
    difference = q - other
    return np.where(prismatic, difference, np.remainder(difference + np.pi, 2 * np.pi) - np.pi)


class JointBuffer:
    """Recent joint readings, written by the encoders' thread and read by the frames' thread.

    Both threads proceed in strictly increasing time. Readings before the last requested frame are dropped. When the
    buffer is full, `put` waits for room, because a recording can be read faster than its frames are stored. With live
    encoders it drops the oldest reading instead, because the thread that reads them may also hold up the arm and must
    not block.
    """

    def __init__(
        self,
        prismatic: NDArray[np.bool_],
        max_gap_s: float,
        capacity: int = 8192,  # maximum number of readings
        *,
        live: bool = False,  # `put` never waits
        kept_s: float = 0.0,  # readings up to this long before the frame are kept [s]
    ) -> None:
        self._prismatic = prismatic
        self.max_gap_s = max_gap_s  # maximum time between the readings around a frame [s]
        self._capacity = capacity
        self._live, self._kept_s = live, kept_s
        self._readings: deque[JointReading] = deque(maxlen=capacity if live else None)
        self._changed = Condition()
        self._expecting = True
        self._closed = False

    def put(self, reading: JointReading) -> None:
        """Add the newest reading. Wait while the buffer is full and not live; do nothing once it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._live or len(self._readings) < self._capacity)
            if self._closed:
                return
            self._readings.append(reading)
            self._expecting = True
            self._changed.notify_all()

    def expect_no_readings(self) -> None:
        """Expect no readings for now: the encoders are lost or have ended. The next `put` resets this."""
        with self._changed:
            self._expecting = False
            self._changed.notify_all()

    def forget_before(self, t: float) -> None:
        """Drop readings that no frame at or after `t` needs: those before the last one `kept_s` before `t`."""
        with self._changed:
            self._forget_before(t)

    def make_room(self) -> None:
        """Drop the older half of a full buffer; no frame has come for so long that none will need it."""
        with self._changed:
            if len(self._readings) >= self._capacity:
                for _ in range(self._capacity // 2):
                    self._readings.popleft()
                self._changed.notify_all()

    def close(self) -> None:
        """Close the buffer and release all waiting threads."""
        with self._changed:
            self._closed = True
            self._expecting = False
            self._changed.notify_all()

    def at(self, t: float, timeout_s: float) -> FloatArray | Reason:
        """Return the joint angles at time `t`, shape (d,), interpolated linearly between the readings around it.

        Waits up to `timeout_s` for a reading at or after `t`. Returns NO_JOINTS if there is no reading on one side of
        `t`, and STALE if the two are farther apart than `max_gap_s`.
        """
        self.forget_before(t)
        with self._changed:
            self._changed.wait_for(lambda: not self._expecting or self._has_reached(t), timeout_s)
            self._forget_before(t)
            if not self._has_reached(t) or self._readings[0].t > t:
                return Reason.NO_JOINTS
            before, after = self._neighbours(t)
        if before.t == t:
            return before.q
        if after.t - before.t > self.max_gap_s + ROUNDING_S:
            return Reason.STALE
        fraction = (t - before.t) / (after.t - before.t)
        return frozen_array(before.q + fraction * joint_difference(after.q, before.q, self._prismatic))

    def time_uncertainty_motion(self, t: float) -> FloatArray:
        """Return the joints' motion within the time uncertainty of the readings around `t`, shape (d,) [rad or m].

        Call it only for a `t` at which `at` returned angles.
        """
        with self._changed:
            before, after = self._neighbours(t)
        sigma_s, gap_s = max(before.t_sigma, after.t_sigma), max(after.t - before.t, ROUNDING_S)
        return frozen_array(sigma_s / gap_s * joint_difference(after.q, before.q, self._prismatic))

    def moved(self, t: float, during_s: float, timeout_s: float) -> FloatArray | Reason:
        """Return the motion of the joints within `during_s` of time `t`, shape (d,) [rad or m], or a reason like `at`.

        It is the mean over both sides, so that an encoder step counts half. If `during_s` is longer than `kept_s`, the
        speed within `kept_s` is extrapolated.
        """
        span_s = min(during_s, self._kept_s)
        before = self.at(t - span_s, timeout_s)
        if isinstance(before, Reason):
            return before
        after = self.at(t + span_s, timeout_s)
        if isinstance(after, Reason):
            return after
        return frozen_array(0.5 * during_s / span_s * joint_difference(after, before, self._prismatic))

    def _has_reached(self, t: float) -> bool:
        return bool(self._readings) and self._readings[-1].t >= t

    def _forget_before(self, t: float) -> None:
        while len(self._readings) > 1 and self._readings[1].t <= t - self._kept_s:
            self._readings.popleft()
        self._changed.notify_all()

    def _neighbours(self, t: float) -> tuple[JointReading, JointReading]:
        """Return the last reading at or before `t`, and the one after it."""
        for before, after in pairwise(self._readings):
            if after.t > t:
                return before, after
        return self._readings[-1], self._readings[-1]
