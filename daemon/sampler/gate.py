"""Decide which measurements become pairs, and which segment they belong to."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyschema.daemon.config import DaemonConfig
from bodyschema.interfaces.records import FloatArray, Pair, Reason

from .align import joint_difference


class _Settings:
    # This many consecutive fixes that agree with each other, but not with the previous position, are accepted.
    confirmations: int = 3
    segment_gap_s: float = 1.0  # a longer pause between pairs starts a new segment
    # Joints that move farther while the time of a frame is uncertain (1-sigma, and what lies between the two eyes'
    # images) are too fast for a pair.
    max_time_error_deg: float = 0.2


class _Fix(NamedTuple):
    t: float
    x: FloatArray


class PairGate:
    """Gate that accepts a measurement if its joint-space step from the last pair is neither too small nor implausible.

    A step is the Euclidean norm over all joints in degrees; prismatic joints count with `metres_per_degree`. A step
    below `min_step_deg` makes no pair, not even after a restart or a pause: an arm at rest must not fill the store.
    A step above `max_step_deg`, a pause of more than a second, a `break_segment` and a marker that jumped start a
    new segment.

    A marker that moved faster than `max_marker_speed_m_s` from its last accepted position is refused. It is accepted
    again in three cases: after `confirmations` consecutive fixes that agree with each other (a tool change), once the
    marker has had the time to move there, or after a pause of more than a second.

    With `any_step`, neither step nor speed is checked: a static recording has no path between its poses.
    """

    def __init__(self, rules: DaemonConfig, prismatic: NDArray[np.bool_], last: Pair | None = None) -> None:
        """Start after `last`, the newest pair in the store."""
        self._prismatic = prismatic
        self.follow(rules)
        self.segment = 0 if last is None else last.segment  # number of the current segment; 0 before the first
        self._q: FloatArray | None = None if last is None else last.q
        self._t: float | None = None
        self._starts_segment = True
        self._accepted: _Fix | None = None
        self._unconfirmed: _Fix | None = None
        self._confirmations = 0

    def follow(self, rules: DaemonConfig) -> None:
        """Apply these rules from now on; the segment continues."""
        self._rules = rules
        self._degrees_per_unit = np.where(self._prismatic, 1 / rules.metres_per_degree, 180 / np.pi)

    def break_segment(self) -> None:
        """Start a new segment with the next pair, regardless of its step."""
        self._starts_segment = True
        self._accepted = None

    def offer(self, t: float, q: FloatArray, x: FloatArray) -> int | Reason:
        """Return the segment if joint angles `q` [rad or m] (d,) and marker `x` [m] (3,) make a pair, or the reason.

        Args:
            t: time of the measurement [s], later than all before.
        """
        rules = self._rules
        if not rules.any_step and not self._is_plausible(_Fix(t, x)):
            return Reason.IMPLAUSIBLE_SPEED
        step_deg = np.inf
        if self._q is not None:
            step_deg = float(np.linalg.norm(joint_difference(q, self._q, self._prismatic) * self._degrees_per_unit))
        if step_deg < rules.min_step_deg and not rules.any_step:
            return Reason.TOO_NEAR
        paused = self._t is None or t - self._t > _Settings.segment_gap_s
        if self._starts_segment or paused or step_deg > rules.max_step_deg:
            self.segment += 1
        self._t, self._q, self._starts_segment = t, q, False
        return self.segment

    def is_too_fast(self, moved: FloatArray) -> bool:
        """Return True if `moved` [rad or m] (d,), the motion within the time uncertainty, is too large for a pair."""
        return float(np.linalg.norm(moved * self._degrees_per_unit)) > _Settings.max_time_error_deg

    def _is_plausible(self, fix: _Fix) -> bool:
        is_consistent = self._is_reachable(self._unconfirmed, fix)
        last = self._accepted
        if last is not None and fix.t - last.t <= _Settings.segment_gap_s and not self._is_reachable(last, fix):
            self._confirmations = self._confirmations + 1 if is_consistent else 1
            self._unconfirmed = fix
            if self._confirmations < _Settings.confirmations:
                return False
        self._starts_segment |= is_consistent
        self._accepted, self._unconfirmed, self._confirmations = fix, None, 0
        return True

    def _is_reachable(self, last: _Fix | None, fix: _Fix) -> bool:
        if last is None:
            return False
        distance = float(np.linalg.norm(fix.x - last.x))
        return distance <= self._rules.max_marker_speed_m_s * (fix.t - last.t)
