"""Check that a message is plausible, and find the time at which its positions were true."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from enum import StrEnum
from statistics import median

from bodyschema.drivers.device_clock import DeviceClock
from bodyschema.drivers.speed_gate import SpeedGate

TICK_S = 1e-9


class _Settings:
    # 146 years: stamps do not wrap
    ticks: int = 1 << 62
    # a message may be faster than all before by this much
    early_s: float = 2e-3
    # plus this share of the time since the last one
    worst_drift: float = 5e-3
    # consecutive early messages after which the others count as late, or the clock as set
    sure_after: int = 3
    # if all are later than the first by this much
    late_s: float = 5e-3
    # for this long, then the first message's stamp was wrong
    late_for_s: float = 1.0
    # messages used to estimate the scatter of delays
    window: int = 51
    # unobservable transit time of the fastest message: 0.2 ms on the loopback interface
    quickest_sigma_s: float = 0.5e-3
    # times advance at half speed at least after a faster message shows that all others were late
    steady: float = 0.5
    # consecutive stamps that all disagree with the clock
    restart_after: int = 3
    # if they are late by less, the network was probably held up
    stall_s: float = 5.0
    anew_after_s: float = 0.5  # for this long: the sender's clock was set
    anew_after_stall_s: float = 10.0  # and catches up within this time


class StampClock:
    """Estimate of the host's time at which a message was stamped.

    A message may take long, but its delay is never negative. The fastest of all messages shows the offset of the
    clocks, up to its own delay. The ratio of the clock rates is estimated as well.
    """

    def __init__(self, max_delay_s: float) -> None:
        """Start without data. A message that took `max_delay_s` longer than the fastest is rejected."""
        self._max_delay_s = max_delay_s
        self._last: tuple[int, float] | None = None  # stamp and time
        self._early: list[float] = []
        self._delays: deque[float] = deque(maxlen=_Settings.window)
        self._least_s = self._began = math.inf
        self._begin(0)

    def time_of(self, stamp_ns: int, arrived: float) -> float | None:
        """Return the host's time [s] at `stamp_ns`, later than that of any earlier timestamp.

        Return None if timestamp and arrival contradict each other.
        """
        if self._is_early(stamp_ns, arrived):
            return None
        if self._last is not None and self.lateness_s(stamp_ns, arrived) > self._max_delay_s:
            return None
        # Relative to the first stamp, because a float of nanoseconds since 1970 is too coarse. Twice the delay:
        # a message in time must agree with all before it, or the clock would restart with it.
        bounds = self._device.narrow(arrived - 2 * self._max_delay_s, arrived, stamp_ns - self._first_ns)
        if bounds is None:
            return None
        t = bounds[1]
        if self._last is not None:
            t = max(t, self._last[1] + _Settings.steady * (stamp_ns - self._last[0]) * TICK_S)
        self._last = stamp_ns, t
        self._heard += 1
        self._delays.append(arrived - t)
        self._note_delay(arrived - t, stamp_ns, arrived)
        return t

    @property
    def sigma_s(self) -> float:
        """1-sigma of the last returned time [s].

        It combines the scatter of the delays with the unknown delay of the fastest message. A delay is at most
        `max_delay_s`, so the fastest of n messages is expected to have taken that divided by n + 1.
        """
        unseen_s = self._max_delay_s / (self._heard + 1)
        return math.hypot(_Settings.quickest_sigma_s, unseen_s, median(self._delays) if self._delays else 0.0)

    def lateness_s(self, stamp_ns: int, arrived: float) -> float:
        """Return by how much later a message arrived than the fastest would have [s]; infinite before the first."""
        if self._last is None:
            return math.inf
        return arrived - self._last[1] - (stamp_ns - self._last[0]) * TICK_S

    def _note_delay(self, delay_s: float, stamp_ns: int, arrived: float) -> None:
        """Restart if a first message with a wrong timestamp makes all others late.

        This is done at the start only. Later, if all are late, the network is slow.
        """
        self._least_s = min(self._least_s, delay_s) if arrived > self._began else math.inf
        if arrived - self._began < _Settings.late_for_s:
            return
        self._began = math.inf
        if self._least_s > _Settings.late_s:
            self._begin(stamp_ns)

    def _is_early(self, stamp_ns: int, arrived: float) -> bool:
        """Return True if the message arrived before its timestamp. A single wrong one must not make all others late."""
        if self._last is None:
            self._begin(stamp_ns)
            self._began = arrived
            return False
        passed_s = (stamp_ns - self._last[0]) * TICK_S
        if self.lateness_s(stamp_ns, arrived) >= -_Settings.early_s - _Settings.worst_drift * abs(passed_s):
            self._early.clear()
            return False
        offset_s = arrived - (stamp_ns - self._first_ns) * TICK_S
        self._early = [early for early in self._early if abs(early - offset_s) < self._max_delay_s] + [offset_s]
        if len(self._early) < _Settings.sure_after:
            return True
        self._begin(stamp_ns)
        return False

    def _begin(self, stamp_ns: int) -> None:
        self._device, self._first_ns, self._last = DeviceClock(TICK_S, _Settings.ticks), stamp_ns, None
        self._early.clear()
        self._delays.clear()
        self._heard = 0


class Refusal(StrEnum):
    """Reason for not using a message, or the reading it would have completed."""

    MALFORMED = "malformed"  # not a sensor_msgs/JointState, truncated, or too long
    NO_POSITIONS = "no_positions"  # it names joints without positions
    TWICE = "twice"  # it names a joint twice
    NOT_FINITE = "not_finite"  # NaN or infinite
    NO_STAMP = "no_stamp"  # its stamp is zero
    DUPLICATE = "duplicate"  # the stamp of the previous message
    OUT_OF_ORDER = "out_of_order"  # an earlier stamp
    DELAYED = "delayed"  # the stamp and the time of arrival do not fit together
    TOO_FAST = "too_fast"  # the joint cannot have moved there in the time
    RIVAL = "rival"  # another node publishes the same joint
    GAP = "gap"  # the joints are spread over messages too far apart in time


class Sender:
    """One node: its clock, and its newest stamp of each joint.

    Attributes:
        heard: arrival of its newest message [s].
        times_set: how often its clock was set to another time.
    """

    def __init__(self, max_delay_s: float) -> None:
        """Start without a message; for `max_delay_s` see `StampClock`."""
        self.heard, self.times_set = -math.inf, 0
        self._max_delay_s = max_delay_s
        self._clock = StampClock(max_delay_s)
        self._newest_ns: dict[int, int] = {}
        self._disagreeing: list[tuple[float, float]] = []

    @property
    def sigma_s(self) -> float:
        """1-sigma of the last returned time [s]."""
        return self._clock.sigma_s

    def time_of(self, stamp_ns: int, places: Sequence[int], arrived: float) -> float | Refusal:
        """Return the time of a message with the joints at `places` [s], or why it is unknown."""
        self.heard = arrived
        if stamp_ns == 0:
            return Refusal.NO_STAMP
        newest_stamps_ns = [self._newest_ns[place] for place in places if place in self._newest_ns]
        if stamp_ns in newest_stamps_ns:
            return Refusal.DUPLICATE
        if any(stamp_ns < newest_ns for newest_ns in newest_stamps_ns):
            return self._note_disagreeing(stamp_ns, arrived, Refusal.OUT_OF_ORDER)
        t = self._clock.time_of(stamp_ns, arrived)
        if t is None:
            return self._note_disagreeing(stamp_ns, arrived, Refusal.DELAYED)
        self._newest_ns.update(dict.fromkeys(places, stamp_ns))
        self._disagreeing.clear()
        return t

    def _note_disagreeing(self, stamp_ns: int, arrived: float, refusal: Refusal) -> Refusal:
        """Restart the clock if only such messages arrive, all off by the same amount: the sender's clock was set."""
        off_s = self._clock.lateness_s(stamp_ns, arrived)
        if self._disagreeing and abs(off_s - self._disagreeing[0][1]) > self._max_delay_s:
            self._disagreeing.clear()
        self._disagreeing = [*self._disagreeing[: _Settings.restart_after - 1], (arrived, off_s)]
        patience_s = _Settings.anew_after_stall_s if 0 < off_s < _Settings.stall_s else _Settings.anew_after_s
        if len(self._disagreeing) == _Settings.restart_after and arrived - self._disagreeing[0][0] > patience_s:
            self._clock, self._newest_ns, self._disagreeing = StampClock(self._max_delay_s), {}, []
            self.times_set += 1
        return refusal


class SpeedGates:
    """Speed gates, one per joint; the first positions are confirmed by the next message."""

    def __init__(self, fastest: Sequence[float], slack: Sequence[float]) -> None:
        """Start without positions.

        Args:
            fastest: highest plausible speed of each joint [rad/s], [m/s] for a prismatic joint.
            slack: additional tolerance of its position [rad] or [m].
        """
        self._limits = list(zip(fastest, slack, strict=True))
        self._gates: list[SpeedGate | None] = [None] * len(self._limits)
        self._confirmed = [False] * len(self._limits)

    def offer(self, t: float, places: Sequence[int], q: Sequence[float]) -> bool | None:
        """Return True if the joints at `places` can be at `q` at time `t` [s]; None when it is too early to tell."""
        verdicts = [self._offer(t, place, value) for place, value in zip(places, q, strict=True)]
        if False in verdicts:
            return False
        return None if None in verdicts else True

    @property
    def jumped(self) -> bool:
        """True if a joint jumped elsewhere between two messages and stays there."""
        return any(gate is not None and gate.jumped for gate in self._gates)

    def _offer(self, t: float, place: int, q: float) -> bool | None:
        gate = self._gates[place]
        if gate is not None and gate.offer(t, (q,)) is None:
            self._confirmed[place] = True
            return True
        if self._confirmed[place]:
            return False
        fastest, slack = self._limits[place]
        self._gates[place] = gate = SpeedGate([fastest], [slack])
        gate.offer(t, (q,))
        return None
