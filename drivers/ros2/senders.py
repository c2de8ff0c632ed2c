"""Whether a message is to be believed, and when it was true."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum

from bodyschema.drivers.turns import SpeedGate

from .stamps import StampClock

ANEW_AFTER = 3  # stamps that all belong to another time
ANEW_AFTER_S = 0.5  # for so long: the sender's clock was set
STALL_S = 5.0  # unless they are late by no more than this: then rather the network was held up,
ANEW_AFTER_STALL_S = 10.0  # and catches up within this


class Refusal(StrEnum):
    """Why a message, or the reading that it would have completed, was not used."""

    MALFORMED = "malformed"  # no sensor_msgs/JointState, or cut off, or too long
    NO_POSITIONS = "no_positions"  # it tells of our joints, but not where they are
    TWICE = "twice"  # it names a joint twice
    NOT_FINITE = "not_finite"  # NaN or infinite
    NO_STAMP = "no_stamp"  # its stamp is zero
    DUPLICATE = "duplicate"  # the stamp of the message before
    OUT_OF_ORDER = "out_of_order"  # an earlier stamp
    DELAYED = "delayed"  # its stamp and its arrival do not fit together
    TOO_FAST = "too_fast"  # a joint cannot have come there
    RIVAL = "rival"  # another node publishes the same joint
    GAP = "gap"  # the joints come in several messages, too far apart in time


class Sender:
    """One node: its clock, and how far it has told of each joint.

    Attributes:
        heard: when its newest message came [s].
        times_set: how often its clock was set to another time.
    """

    def __init__(self, max_delay_s: float) -> None:
        """Nothing was heard of it yet; for `max_delay_s` see `StampClock`."""
        self.heard, self.times_set = -math.inf, 0
        self._max_delay_s = max_delay_s
        self._clock = StampClock(max_delay_s)
        self._newest_ns: dict[int, int] = {}
        self._astray: list[tuple[float, float]] = []

    @property
    def sigma_s(self) -> float:
        """1-sigma of the last time told [s]."""
        return self._clock.sigma_s

    def time_of(self, stamp_ns: int, places: Sequence[int], arrived: float) -> float | Refusal:
        """When the message was true [s] that tells of the joints at `places`, or why nothing tells that."""
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
        """When none but such messages come, all off by the same, the clock that stamps them was set: begin anew."""
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
    """Believes of each joint only where it can have come to; of the first two messages, where they agree."""

    def __init__(self, fastest: Sequence[float], slack: Sequence[float]) -> None:
        """Gates that have seen nothing.

        Args:
            fastest: how fast each joint is believed to move [rad/s], m/s where it slides.
            slack: how far its position may be off besides [rad] or [m].
        """
        self._limits = list(zip(fastest, slack, strict=True))
        self._gates: list[SpeedGate | None] = [None] * len(self._limits)
        self._confirmed = [False] * len(self._limits)

    def offer(self, t: float, places: Sequence[int], q: Sequence[float]) -> bool | None:
        """Whether the joints at `places` can be at `q` at the time `t` [s]; None when it is too early to tell."""
        verdicts = [self._offer(t, place, value) for place, value in zip(places, q, strict=True)]
        if False in verdicts:
            return False
        return None if None in verdicts else True

    @property
    def jumped(self) -> bool:
        """A joint is somewhere else from one message to the next, and stays there."""
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
