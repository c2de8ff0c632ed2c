"""Run a device behind a port in virtual time: millions of transactions without waiting."""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from heapq import heappop, heappush

from bodyschema.drivers.emulator.device import Device, Reply, byte_s


class VirtualClock:
    """A clock that advances only when a caller waits."""

    def __init__(self, start: float = 100.0) -> None:
        self._now = start

    def now(self) -> float:
        """Return the virtual time [s]."""
        return self._now

    def utc(self) -> str:
        """Return the virtual time since 2026 in ISO 8601, UTC."""
        return (datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=self._now)).isoformat(timespec="milliseconds")

    def wait_until(self, t: float) -> None:
        """Advance the time to `t`, unless it is later already."""
        self._now = max(self._now, t)


def at_once() -> float:
    """Return a delay of zero."""
    return 0.0


class VirtualPort:
    """A serial port as the driver uses it, with a device at its other end."""

    def __init__(
        self,
        device: Device,
        clock: VirtualClock,
        baud: int = 1_000_000,
        *,
        outwards: Callable[[], float] = at_once,
        inwards: Callable[[], float] = at_once,
    ) -> None:
        """Open the port.

        Args:
            device: the device at the other end.
            clock: the virtual clock.
            baud: bits per second.
            outwards: returns the delay from the program to the wire [s], sampled for each packet.
            inwards: returns the delay from the wire to the program [s], sampled for each request or unsolicited packet.
        """
        self.device = device
        self._clock, self._baud = clock, baud
        self._outwards, self._inwards = outwards, inwards
        self._arriving: list[tuple[float, int, bytes]] = []
        self._order, self._brought_s = 0, 0.0

    @property
    def baud(self) -> int:
        """Bits per second."""
        return self._baud

    def close(self) -> None:
        """Discard everything in transit."""
        self._arriving.clear()

    def write(self, data: bytes) -> None:
        """Send `data`."""
        self._bring(self.device.send(data, self._clock.now() + self._outwards(), self._baud))

    def receive(self, until: float) -> bytes:
        """Return what has arrived, else what arrives next; empty when nothing arrives before `until`."""
        while self.device.speaks_at <= min(until, self._arriving[0][0] if self._arriving else math.inf):
            self._bring_in_order(self.device.speak(self.device.speaks_at, self._baud))
        if not self._arriving or self._arriving[0][0] > until:
            self._clock.wait_until(until)
            return b""
        self._clock.wait_until(self._arriving[0][0])
        return self._arrived()

    def flush(self) -> None:
        """Discard what has arrived."""
        self._bring_in_order(self.device.speak(self._clock.now(), self._baud))
        self._arrived()

    def _bring_in_order(self, replies: list[Reply]) -> None:
        """Queue unsolicited packets, each with its own delay, without letting one overtake another."""
        for reply in replies:
            end = reply.start + len(reply.data) * byte_s(self._baud)
            self._brought_s = max(self._brought_s, end + self._inwards())
            self._order += 1
            heappush(self._arriving, (self._brought_s, self._order, reply.data))

    def _bring(self, replies: list[Reply]) -> None:
        inwards_s = self._inwards()
        for reply in replies:
            self._order += 1
            arrival = reply.start + len(reply.data) * byte_s(self._baud) + inwards_s
            heappush(self._arriving, (arrival, self._order, reply.data))

    def _arrived(self) -> bytes:
        data = b""
        while self._arriving and self._arriving[0][0] <= self._clock.now():
            data += heappop(self._arriving)[2]
        return data
