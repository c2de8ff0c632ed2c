"""Emulate nodes at the other end of a link in virtual time: an hour of messages in seconds, without waiting."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from heapq import heappop, heappush, heapreplace
from typing import Protocol

from bodyschema.drivers.ros2.emulator.node import Node, Sent
from bodyschema.drivers.ros2.link import Sample
from bodyschema.interfaces.protocols import Clock


class Waiting(Clock, Protocol):
    """A clock that advances only when a caller waits."""

    def wait_until(self, t: float) -> None:
        """Advance the time to `t`, unless it is later already."""
        ...


def at_once() -> float:
    """Return a delay of zero."""
    return 0.0


class VirtualLink:
    """A link that delivers the messages that nodes publish from now on.

    Attributes:
        is_connected: True while the router is reachable; otherwise nothing arrives.
        known: liveliness tokens of publishers.
    """

    def __init__(self, nodes: Sequence[Node], clock: Waiting, *, delay: Callable[[], float] = at_once) -> None:
        """Create a link on which nothing was sent yet.

        Args:
            nodes: at the other end.
            clock: the virtual clock.
            delay: returns the transit time of a message [s], sampled for each; messages of one node keep their order.
        """
        self.is_connected = True
        self.known: list[str] = []
        self._clock, self._delay = clock, delay
        self._nodes = list(nodes)
        self._due = [(clock.now() + node.period_s, place) for place, node in enumerate(nodes)]
        self._arriving: list[tuple[float, int, Sent]] = []
        self._order = 0
        self._arrived = [0.0] * len(self._nodes)

    def receive(self, until: float) -> Sample | None:
        """Return the next message; None when none arrives by `until` [s], or the router is unreachable."""
        while self.is_connected:
            first = self._arriving[0][0] if self._arriving else until
            if self._due and self._due[0][0] <= min(first, until):
                self._publish()
                continue
            if not self._arriving or first > until:
                break
            arrived, _, sent = heappop(self._arriving)
            self._clock.wait_until(arrived)
            return Sample(sent.payload, sent.attached, arrived)
        self._clock.wait_until(until)
        return None

    def tokens(self) -> Sequence[str]:
        """Return the liveliness tokens of publishers."""
        return self.known

    def close(self) -> None:
        """Discard everything in transit."""
        self._arriving.clear()

    def _publish(self) -> None:
        t, place = self._due[0]
        node = self._nodes[place]
        heapreplace(self._due, (t + node.period_s, place))
        sent = node.at(t)
        if sent is not None:
            self._order += 1
            self._arrived[place] = max(self._arrived[place], t + self._delay())
            heappush(self._arriving, (self._arrived[place], self._order, sent))
