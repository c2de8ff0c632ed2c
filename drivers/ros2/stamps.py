"""The clock of a publisher's stamps against the host's."""

from __future__ import annotations

import math
from collections import deque
from statistics import median

from bodyschema.drivers.device_clock import DeviceClock

TICK_S = 1e-9
TICKS = 1 << 62  # 146 years: stamps do not wrap
EARLY_S = 2e-3  # by so much a message may be quicker than all before it
WORST_DRIFT = 5e-3  # and by this share of the time since the last one
SURE_AFTER = 3  # messages in a row that came too early: the others were late then, or the clock was set
LATE_S = 5e-3  # when all are later than the first by so much,
LATE_FOR_S = 1.0  # for so long, then the first's stamp was wrong
LATELY = 51  # messages that tell how much the delays scatter
QUICKEST_SIGMA_S = 0.5e-3  # what the quickest message took, nothing tells: on the loopback interface 0.2 ms
STEADY = 0.5  # times go on at half speed at least while a quicker message shows that all came later than thought


class StampClock:
    """Tells on the host's clock when a message was stamped.

    A message may take long, but never less than none: the quickest of all shows how far the clocks are apart, up to
    what it took itself. That the two run at different rates is learnt on the way.
    """

    def __init__(self, max_delay_s: float) -> None:
        """A clock of which nothing is known.

        Args:
            max_delay_s: a message that took so much longer than the quickest is refused.
        """
        self._max_delay_s = max_delay_s
        self._last: tuple[int, float] | None = None  # stamp and time
        self._early: list[float] = []
        self._delays: deque[float] = deque(maxlen=LATELY)
        self._least_s = self._began = math.inf
        self._begin(0)

    def time_of(self, stamp_ns: int, arrived: float) -> float | None:
        """The host's time [s] at `stamp_ns`, later than that of any stamp before.

        None when the stamp is of another time than the message.

        Args:
            stamp_ns: later than all before.
            arrived: when the message came [s].
        """
        if self._is_early(stamp_ns, arrived) or self._is_late(stamp_ns, arrived):
            return None
        # From the first stamp on, because a float of nanoseconds since 1970 is too coarse.
        # Twice the delay: what is not late has to agree with all before, or the clock would begin anew with it.
        bounds = self._device.narrow(arrived - 2 * self._max_delay_s, arrived, stamp_ns - self._first_ns)
        if bounds is None:
            return None
        t = bounds[1]
        if self._last is not None:
            t = max(t, self._last[1] + STEADY * (stamp_ns - self._last[0]) * TICK_S)
        self._last = stamp_ns, t
        self._heard += 1
        self._delays.append(arrived - t)
        self._note_delay(arrived - t, stamp_ns, arrived)
        return t

    @property
    def sigma_s(self) -> float:
        """1-sigma of the last time told [s].

        That of the delays' scatter, and of what the quickest message took: a message may take up to the longest
        delay, so the quickest of n is expected to have taken that by n + 1.
        """
        unseen_s = self._max_delay_s / (self._heard + 1)
        return math.hypot(QUICKEST_SIGMA_S, unseen_s, median(self._delays) if self._delays else 0.0)

    def lateness_s(self, stamp_ns: int, arrived: float) -> float:
        """How much later a message came than the quickest would have; infinite before any."""
        if self._last is None:
            return math.inf
        return arrived - self._last[1] - (stamp_ns - self._last[0]) * TICK_S

    def _note_delay(self, delay_s: float, stamp_ns: int, arrived: float) -> None:
        """Begin anew when, at the start, a first message whose stamp was wrong makes all others late.

        Later on, when all are late, the network is slow.
        """
        self._least_s = min(self._least_s, delay_s) if arrived > self._began else math.inf
        if arrived - self._began < LATE_FOR_S:
            return
        self._began = math.inf
        if self._least_s > LATE_S:
            self._begin(stamp_ns)

    def _is_early(self, stamp_ns: int, arrived: float) -> bool:
        """Whether the message came before it was stamped; one wrong stamp must not make all others late."""
        if self._last is None:
            self._begin(stamp_ns)
            self._began = arrived
            return False
        passed_s = (stamp_ns - self._last[0]) * TICK_S
        if self.lateness_s(stamp_ns, arrived) >= -EARLY_S - WORST_DRIFT * abs(passed_s):
            self._early.clear()
            return False
        offset_s = arrived - (stamp_ns - self._first_ns) * TICK_S
        self._early = [early for early in self._early if abs(early - offset_s) < self._max_delay_s] + [offset_s]
        if len(self._early) < SURE_AFTER:
            return True
        self._begin(stamp_ns)
        return False

    def _is_late(self, stamp_ns: int, arrived: float) -> bool:
        return self._last is not None and self.lateness_s(stamp_ns, arrived) > self._max_delay_s

    def _begin(self, stamp_ns: int) -> None:
        self._device, self._first_ns, self._last = DeviceClock(TICK_S, TICKS), stamp_ns, None
        self._early.clear()
        self._delays.clear()
        self._heard = 0
