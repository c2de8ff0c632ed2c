"""One node's joint states: whether a message is to be believed, and when it was true."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from drivers.turns import SpeedGate

from .messages import JointState
from .stamps import StampClock

ANEW_AFTER_S = 0.5  # of stamps that all belong to another time: the sender's clock was set
ANEW_AFTER = 3  # and so many of them


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


@dataclass(frozen=True, slots=True)
class Believed:
    """What a message tells.

    Attributes:
        t: when it was true [s].
        q: positions of the sender's joints.
    """

    t: float
    q: tuple[float, ...]


class Sender:
    """One node, and the names that its messages have.

    Attributes:
        places: which of our joints it tells of.
        heard: when its newest message came [s].
    """

    def __init__(
        self,
        names: Sequence[str],
        wanted: Sequence[str],
        fastest: Sequence[float],
        slack: Sequence[float],
        delay_s: float,
    ) -> None:
        """Nothing was heard of it yet.

        Args:
            names: of its messages.
            wanted: what ROS calls our joints.
            fastest: how fast each of ours is believed to move [rad/s], m/s where it slides.
            slack: how far its position may be off [rad] or [m].
            delay_s: see `StampClock`.
        """
        self.places = tuple(place for place, name in enumerate(wanted) if name in names)
        self.heard = -math.inf
        self.clock_was_set = False
        self._columns = tuple(names.index(wanted[place]) for place in self.places)
        self._names_twice = any(names.count(wanted[place]) > 1 for place in self.places)
        self._gate = SpeedGate([fastest[place] for place in self.places], [slack[place] for place in self.places])
        self._delay_s = delay_s
        self._clock = StampClock(delay_s)
        self._newest_ns: int | None = None
        self._astray: list[float] = []

    @property
    def jumped(self) -> bool:
        """Its joints are somewhere else from one message to the next, and stay there."""
        return self._gate.jumped

    def offer(self, message: JointState, arrived: float) -> Believed | Refusal:
        """What the message tells, or why it is not to be used."""
        self.heard = arrived
        if self._names_twice:
            return Refusal.TWICE
        if not message.positions:
            return Refusal.NO_POSITIONS
        q = tuple([message.positions[column] for column in self._columns])
        if not all(map(math.isfinite, q)):
            return Refusal.NOT_FINITE
        if message.header.stamp_ns == 0:
            return Refusal.NO_STAMP
        t = self._time(message.header.stamp_ns, arrived)
        if isinstance(t, Refusal):
            return t
        if self._gate.offer(t, q) is not None:
            return Refusal.TOO_FAST
        return Believed(t, q)

    def _time(self, stamp_ns: int, arrived: float) -> float | Refusal:
        if stamp_ns == self._newest_ns:
            return Refusal.DUPLICATE
        if self._newest_ns is not None and stamp_ns < self._newest_ns:
            t, refusal = None, Refusal.OUT_OF_ORDER
        else:
            t, refusal = self._clock.time_of(stamp_ns, arrived), Refusal.DELAYED
        if t is None:
            self._astray = [*self._astray[: ANEW_AFTER - 1], arrived]
            if len(self._astray) == ANEW_AFTER and arrived - self._astray[0] > ANEW_AFTER_S:
                self._clock, self._newest_ns, self._astray = StampClock(self._delay_s), None, []
                self.clock_was_set = True
            return refusal
        self._newest_ns, self._astray = stamp_ns, []
        return t
