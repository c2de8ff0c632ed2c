"""A device's own clock, which ticks coarsely, drifts and wraps, against the host's."""

from __future__ import annotations


class DeviceClock:
    """Narrows down when a device did something that it stamped with its own clock.

    The host knows an interval for each event: not before it asked, not after it was told. The stamp knows another, one
    tick wide, up to the offset of the two clocks. The intervals of all events have this offset in common, so it is
    soon known to a fraction of a tick, and an event whose intervals do not meet is not what it pretends to be.
    """

    def __init__(self, tick_s: float, ticks: int, drift: float = 3e-4, slack_s: float = 0.5e-3) -> None:
        """A clock of which nothing is known.

        Args:
            tick_s: length of a tick.
            ticks: the stamps count from 0 to this, excluded.
            drift: largest difference of the two clocks' rates.
            slack_s: intervals that miss each other by this are still believed.
        """
        self._tick_s, self._ticks, self._drift, self._slack_s = tick_s, ticks, drift, slack_s
        self._low = self._high = 0.0  # bounds of host time minus device time
        self._seen_s: float | None = None

    def narrow(self, earliest: float, latest: float, stamp: int) -> tuple[float, float] | None:
        """The bounds of an event's time that the stamp leaves of `earliest` .. `latest` [s].

        None when the stamp belongs to another time; nothing is learnt from it then.
        """
        if self._seen_s is None:
            return self._learn(earliest, latest, stamp * self._tick_s, latest)
        spread = self._drift * abs(latest - self._seen_s)
        low, high = self._low - spread, self._high + spread
        device_s = self._unwrapped(stamp, (earliest + latest) / 2 - (low + high) / 2)
        first, last = device_s + low, device_s + self._tick_s + high
        if first > latest + self._slack_s or last < earliest - self._slack_s:
            return None
        self._low, self._high = low, high
        return self._learn(earliest, latest, device_s, latest)

    def _unwrapped(self, stamp: int, expected_s: float) -> float:
        wrap_s = self._ticks * self._tick_s
        device_s = stamp * self._tick_s
        return device_s + wrap_s * round((expected_s - device_s - self._tick_s / 2) / wrap_s)

    def _learn(self, earliest: float, latest: float, device_s: float, now: float) -> tuple[float, float]:
        low, high = earliest - device_s - self._tick_s, latest - device_s
        if self._seen_s is not None:
            common = max(low, self._low), min(high, self._high)
            # The wire was slower or faster than thought: begin anew with this event.
            low, high = common if common[0] <= common[1] else (low, high)
        self._low, self._high, self._seen_s = low, high, now
        first, last = max(earliest, device_s + low), min(latest, device_s + self._tick_s + high)
        return (first, last) if first <= last else (earliest, latest)
