"""Map a device's own clock, which is coarse, drifts and wraps, to the host's clock."""

from __future__ import annotations

import math
from collections import deque


class _Settings:
    # difference of the clock rates until it is estimated, and its later change
    drift: float = 3e-4
    # intervals that miss each other by less are still accepted
    slack_s: float = 0.5e-3
    # largest difference of clock rates that is tolerated until the rate is estimated
    worst: float = 0.02
    window_s: float = 20.0
    bucket_s: float = 0.1
    # until this much was observed, the rate stays 1
    early_s: float = 1.0
    # a stamp further ahead is rejected; one less ahead shows that all earlier messages were delayed
    ahead_s: float = 0.02
    # two buckets define the edge; the next few show its uncertainty
    near_edge: int = 6
    # buckets whose least delay is used until the rate is known
    lately: int = 3
    # USB polls every millisecond, so the delay of the fastest message is unknown
    quickest_sigma_s: float = 1e-3 / math.sqrt(3)
    relearn_after_s: float = 30.0  # interval between two comparisons of the rates
    known_after_s: float = 1.0  # shortest comparison that changes the rate
    longest_held_s: float = 0.5  # longer after its stamp, or at first before it, no message belongs to it


class DeviceClock:
    """Map from a device clock to host time, for events that answer a request.

    The host knows an interval for each event: after the request, and before the answer arrived. The timestamp gives
    another interval, one tick wide, up to the offset between the clocks. The intervals of all events share this offset,
    so it is soon known to a fraction of a tick. If an event's two intervals do not overlap, its timestamp is wrong.

    The ratio of the clock rates is estimated too: a clock without a crystal is off by a percent.
    """

    def __init__(self, tick_s: float, ticks: int) -> None:
        """Start without knowledge of the offset; the stamps count ticks of `tick_s` from 0 to `ticks`, excluded."""
        self._tick_s, self._ticks = tick_s, ticks
        self._rate, self._spread = 1.0, _Settings.drift
        self._low = self._high = 0.0  # bounds of host time minus device time
        self._host_s = self._device_s = 0.0  # of the last event
        self._is_known = False
        self._begin: tuple[float, float, float] | None = None

    def narrow(self, earliest: float, latest: float, stamp: int) -> tuple[float, float] | None:
        """Return the part of the interval `earliest` .. `latest` [s] that is consistent with the stamp.

        Return None when the stamp does not belong to this interval; the state is not updated then.
        """
        if self._begin is None:
            self._device_s = stamp * self._tick_s
            self._begin = (earliest, latest, self._device_s)
            self._low, self._high = self._offsets(earliest, latest, self._device_s)
            self._host_s = latest
            return earliest, latest
        spread = self._spread * abs(latest - self._host_s)
        low, high = self._low - spread, self._high + spread
        device_s = self._unwrapped(stamp, ((earliest + latest) - (low + high)) / (2 * self._rate))
        first = device_s * self._rate + low
        last = (device_s + self._tick_s) * self._rate + high
        slack_s = _Settings.slack_s + (0.0 if self._is_known else _Settings.worst * (latest - self._begin[1]))
        if first > latest + slack_s or last < earliest - slack_s:
            return None
        offsets = self._offsets(earliest, latest, device_s)
        common = max(low, offsets[0]), min(high, offsets[1])
        # Without overlap the delay on the wire differed from the assumption: restart from this event.
        self._low, self._high = common if common[0] <= common[1] else offsets
        self._host_s, self._device_s = latest, device_s
        first = max(earliest, device_s * self._rate + self._low)
        last = min(latest, (device_s + self._tick_s) * self._rate + self._high)
        self._learn_rate(earliest, latest)
        return (first, last) if first <= last else (earliest, latest)

    def _offsets(self, earliest: float, latest: float, device_s: float) -> tuple[float, float]:
        return earliest - (device_s + self._tick_s) * self._rate, latest - device_s * self._rate

    def _unwrapped(self, stamp: int, expected_s: float) -> float:
        wrap_s = self._ticks * self._tick_s
        device_s = stamp * self._tick_s
        return device_s + wrap_s * round((expected_s - device_s - self._tick_s / 2) / wrap_s)

    def _learn_rate(self, earliest: float, latest: float) -> None:
        """Update the rate from the time elapsed on both clocks, and restart the comparison every `relearn_after_s`."""
        if self._begin is None or self._device_s - self._begin[2] < _Settings.known_after_s:
            return
        self._is_known = True
        passed_s = self._device_s - self._begin[2]
        rate = (earliest + latest - self._begin[0] - self._begin[1]) / (2 * passed_s)
        unsure_s = (latest - earliest + self._begin[1] - self._begin[0]) / 2 + self._tick_s
        if unsure_s / passed_s < max(self._spread, abs(rate - self._rate)):
            turned = (self._rate - rate) * self._device_s  # keeps the offset at the present unchanged
            self._low, self._high = self._low + turned, self._high + turned
            self._rate, self._spread = rate, max(_Settings.drift, unsure_s / passed_s)
        if passed_s > _Settings.relearn_after_s:
            self._begin = (earliest, latest, self._device_s)


class StreamClock:
    """Map from a device clock to host time, for events that the device sends without being asked.

    The host knows only the arrival time. It is later than the event by a delay that is never negative and is often
    close to its minimum. So the clock offset follows the lower edge of arrival minus stamp, and the slope of this edge
    is the difference of the clock rates. (Moon, Skelly, Towsley 1999: the nearest line below all points; it contains
    the edge of their lower convex hull over their mean.)

    Attributes:
        rate: host seconds per device second.
        sigma_s: 1-sigma of an estimated time [s]; infinite while there is too little data.
    """

    def __init__(self, tick_s: float, ticks: int) -> None:
        """Start without data; the stamps count from 0 to `ticks`, excluded."""
        self._tick_s, self._wrap_s = tick_s, tick_s * ticks
        self._least: deque[tuple[float, float]] = deque()  # by bucket: device time, least arrival minus device time
        self._device_s = self._origin_s = self._bucket_s = 0.0
        self._offset_s, self.rate = 0.0, 1.0
        self._edge_s = self._above_s = 0.0  # length of the edge; distance of the next buckets' minima above it

    @property
    def sigma_s(self) -> float:
        """1-sigma of an estimated time [s]: delay of the fastest message, and uncertainty of the edge."""
        if len(self._least) <= _Settings.lately:
            return math.inf
        if not self._edge_s:
            lately = [offset for _, offset in list(self._least)[-_Settings.lately :]]
            unknown_rate_s = _Settings.worst * _Settings.lately * _Settings.bucket_s / math.sqrt(3)
            return math.hypot(_Settings.quickest_sigma_s, unknown_rate_s, max(lately) - min(lately))
        fraction = (self._device_s - self._origin_s) / self._edge_s
        return math.hypot(_Settings.quickest_sigma_s, self._above_s * math.hypot(1 - fraction, fraction))

    def time(self, latest: float, stamp: int) -> float | None:
        """Return the time of the event whose message arrived at `latest` [s].

        Return None when the stamp does not belong to this time; the state is not updated then.
        """
        if not self._least:
            self._device_s = self._origin_s = stamp * self._tick_s
            self._offset_s = latest - self._device_s
        device_s = self._unwrapped(stamp, latest)
        t = self._mapped(device_s)
        is_early = device_s - self._least[0][0] < _Settings.early_s if self._least else True
        ahead_s = _Settings.longest_held_s if is_early else _Settings.ahead_s
        if latest - t > _Settings.longest_held_s or t - latest > ahead_s:
            return None
        self._device_s = max(device_s, self._device_s)
        self._note(device_s, latest - device_s)
        return min(self._mapped(device_s), latest)

    def _mapped(self, device_s: float) -> float:
        return device_s + self._offset_s + (self.rate - 1.0) * (device_s - self._origin_s)

    def _unwrapped(self, stamp: int, latest: float) -> float:
        device_s = stamp * self._tick_s
        expected_s = self._device_s + (latest - self._mapped(self._device_s))
        return device_s + self._wrap_s * round((expected_s - device_s) / self._wrap_s)

    def _note(self, device_s: float, offset_s: float) -> None:
        least = self._least
        if not least or device_s - self._bucket_s >= _Settings.bucket_s:
            self._bucket_s = device_s
            least.append((device_s, offset_s))
            while least[-1][0] - least[0][0] > _Settings.window_s:
                least.popleft()
            self._fit()
        elif offset_s < least[-1][1]:
            least[-1] = (device_s, offset_s)
            if device_s + offset_s < self._mapped(device_s):
                self._fit()

    def _fit(self) -> None:
        points = list(self._least)
        if points[-1][0] - points[0][0] < _Settings.early_s:
            self._origin_s, self._offset_s = points[-1][0], min(offset for _, offset in points[-3:])
            return
        mean = sum(device_s for device_s, _ in points) / len(points)
        (x0, y0), (x1, y1) = _edge_below(points, mean)
        slope = min(max((y1 - y0) / (x1 - x0), -_Settings.worst), _Settings.worst)
        self.rate, self._origin_s, self._offset_s, self._edge_s = 1.0 + slope, x0, y0, x1 - x0
        above = sorted(y - y0 - slope * (x - x0) for x, y in points)
        self._above_s = above[min(_Settings.near_edge, len(above) - 1)]


def _edge_below(points: list[tuple[float, float]], x: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the edge of the lower convex hull of `points` (sorted by x) at `x`."""
    hull: list[tuple[float, float]] = []
    for point in points:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (x1 - x0) * (point[1] - y0) > (y1 - y0) * (point[0] - x0):
                break
            hull.pop()
        hull.append(point)
    last = next(k for k, corner in enumerate(hull) if k > 0 and corner[0] >= x)
    return hull[last - 1], hull[last]
