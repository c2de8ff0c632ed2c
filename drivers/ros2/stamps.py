"""The clock of a publisher's stamps against the host's."""

from __future__ import annotations

from drivers.device_clock import DeviceClock

TICK_S = 1e-9
TICKS = 1 << 62  # 146 years: stamps do not wrap
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
        self._device = DeviceClock(TICK_S, TICKS)
        self._first_ns: int | None = None
        self._last: tuple[int, float] | None = None

    def time_of(self, stamp_ns: int, arrived: float) -> float | None:
        """The host's time [s] at `stamp_ns`, later than that of any stamp before.

        None when the stamp is of another time than the message.

        Args:
            stamp_ns: later than all before.
            arrived: when the message came [s].
        """
        if self._first_ns is None:
            self._first_ns = stamp_ns
        # From the first stamp on, because a float of nanoseconds since 1970 is too coarse.
        bounds = self._device.narrow(arrived - self._max_delay_s, arrived, stamp_ns - self._first_ns)
        if bounds is None:
            return None
        t = bounds[1]
        if self._last is not None:
            t = max(t, self._last[1] + STEADY * (stamp_ns - self._last[0]) * TICK_S)
        self._last = stamp_ns, t
        return t
