"""Map the clock of a publisher's stamps to the host's clock."""

from __future__ import annotations

import math
from collections import deque
from statistics import median

from bodyschema.drivers.device_clock import DeviceClock

TICK_S = 1e-9
TICKS = 1 << 62  # 146 years: stamps do not wrap
EARLY_S = 2e-3  # a message may be faster than all before by this much
WORST_DRIFT = 5e-3  # plus this share of the time since the last one
SURE_AFTER = 3  # consecutive early messages after which the others count as late, or the clock as set
LATE_S = 5e-3  # if all are later than the first by this much
LATE_FOR_S = 1.0  # for this long, then the first message's stamp was wrong
LATELY = 51  # messages used to estimate the scatter of delays
QUICKEST_SIGMA_S = 0.5e-3  # unobservable transit time of the fastest message: 0.2 ms on the loopback interface
STEADY = 0.5  # times advance at half speed at least after a faster message shows that all others were late


class StampClock:
    """Estimate of the host's time at which a message was stamped.

    A message may take long, but its delay is never negative. The fastest of all shows the offset of the clocks, up to
    its own delay. The ratio of the clock rates is estimated as well.
    """

    def __init__(self, max_delay_s: float) -> None:
        """Start without data.

        Args:
            max_delay_s: a message that took this much longer than the fastest is rejected.
        """
        self._max_delay_s = max_delay_s
        self._last: tuple[int, float] | None = None  # stamp and time
        self._early: list[float] = []
        self._delays: deque[float] = deque(maxlen=LATELY)
        self._least_s = self._began = math.inf
        self._begin(0)

    def time_of(self, stamp_ns: int, arrived: float) -> float | None:
        """Return the host's time [s] at `stamp_ns`, later than that of any earlier stamp.

        Return None when stamp and arrival do not fit together.

        Args:
            stamp_ns: later than all before.
            arrived: arrival of the message [s].
        """
        if self._is_early(stamp_ns, arrived) or self._is_late(stamp_ns, arrived):
            return None
        # Relative to the first stamp, because a float of nanoseconds since 1970 is too coarse. Twice the delay:
        # a message in time must agree with all before it, or the clock would restart with it.
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
        """1-sigma of the last returned time [s].

        It combines the scatter of the delays with the unknown delay of the fastest message. A delay is at most
        `max_delay_s`, so the fastest of n messages is expected to have taken that divided by n + 1.
        """
        unseen_s = self._max_delay_s / (self._heard + 1)
        return math.hypot(QUICKEST_SIGMA_S, unseen_s, median(self._delays) if self._delays else 0.0)

    def lateness_s(self, stamp_ns: int, arrived: float) -> float:
        """Return how much later a message arrived than the fastest would have [s]; infinite before any."""
        if self._last is None:
            return math.inf
        return arrived - self._last[1] - (stamp_ns - self._last[0]) * TICK_S

    def _note_delay(self, delay_s: float, stamp_ns: int, arrived: float) -> None:
        """Restart if a first message with a wrong stamp makes all others late.

        This is done at the start only. Later on, when all are late, the network is slow.
        """
        self._least_s = min(self._least_s, delay_s) if arrived > self._began else math.inf
        if arrived - self._began < LATE_FOR_S:
            return
        self._began = math.inf
        if self._least_s > LATE_S:
            self._begin(stamp_ns)

    def _is_early(self, stamp_ns: int, arrived: float) -> bool:
        """Return True if the message arrived before its stamp. A single wrong stamp must not make all others late."""
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
