"""Decide if a message is plausible, and at what time its positions were true."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum

from bodyschema.drivers.turns import SpeedGate

from .stamps import StampClock

ANEW_AFTER = 3  # consecutive stamps that all disagree with the clock
ANEW_AFTER_S = 0.5  # for this long: the sender's clock was set
STALL_S = 5.0  # if they are late by less, the network was probably held up
ANEW_AFTER_STALL_S = 10.0  # and catches up within this time


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
        self._astray: list[tuple[float, float]] = []

    @property
    def sigma_s(self) -> float:
        """1-sigma of the last returned time [s]."""
        return self._clock.sigma_s

    def time_of(self, stamp_ns: int, places: Sequence[int], arrived: float) -> float | Refusal:
        """Return the time of a message with the joints at `places` [s], or why it is unknown."""
        self.heard = arrived
        if stamp_ns == 0:
            return Refusal.NO_STAMP
        told_ns = [self._newest_ns[place] for place in places if place in self._newest_ns]
        if stamp_ns in told_ns:
            return Refusal.DUPLICATE
        if any(stamp_ns < newest_ns for newest_ns in told_ns):
            return self._astray_at(stamp_ns, arrived, Refusal.OUT_OF_ORDER)
        t = self._clock.time_of(stamp_ns, arrived)
        if t is None:
            return self._astray_at(stamp_ns, arrived, Refusal.DELAYED)
        self._newest_ns.update(dict.fromkeys(places, stamp_ns))
        self._astray.clear()
        return t

    def _astray_at(self, stamp_ns: int, arrived: float, refusal: Refusal) -> Refusal:
        """Restart the clock if only such messages arrive, all off by the same amount: the sender's clock was set."""
        off_s = self._clock.lateness_s(stamp_ns, arrived)
        if self._astray and abs(off_s - self._astray[0][1]) > self._max_delay_s:
            self._astray.clear()
        self._astray = [*self._astray[: ANEW_AFTER - 1], (arrived, off_s)]
        patience_s = ANEW_AFTER_STALL_S if 0 < off_s < STALL_S else ANEW_AFTER_S
        if len(self._astray) == ANEW_AFTER and arrived - self._astray[0][0] > patience_s:
            self._clock, self._newest_ns, self._astray = StampClock(self._max_delay_s), {}, []
            self.times_set += 1
        return refusal


class Gates:
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
        """True if a joint moved elsewhere from one message to the next and stays there."""
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
