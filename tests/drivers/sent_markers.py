"""A marker source whose messages are scripted, in virtual time."""

from __future__ import annotations

import json
from collections import deque
from pathlib import Path

from virtual_port import VirtualClock

from bodyschema.drivers.markers.config import source_tables
from bodyschema.drivers.markers.datagram import SCHEMA, decode_datagram
from bodyschema.drivers.markers.report import Packet
from bodyschema.drivers.markers.stream import MarkerStream

PERIOD_S = 0.01
AHEAD_S = 5000.0  # the sender's clock


def table(**keys):
    """Return the source of [marker_source] with these keys; kind is udp unless given."""
    return source_tables({"kind": "udp"} | keys, Path("robot.toml"), "")[0]


class Scripted:
    """A `Receiver` of the datagrams that a test sends."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._packets: deque[Packet] = deque()

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    def receive(self, until: float) -> Packet | None:
        return self._packets.popleft() if self._packets else None

    def silence(self) -> str:
        return "start it"

    def put(self, payload: bytes, sender: str) -> None:
        self._packets.append(Packet(payload, sender, self._clock.now()))


class Sent:
    """An open source, and a program that sends to it at 100 Hz."""

    def __init__(self, **keys) -> None:
        self.clock = VirtualClock()
        self.wire = Scripted(self.clock)
        self.stream = MarkerStream(table(**keys), self.wire, decode_datagram, self.clock)
        self.stream.__enter__()
        self.seq = 0

    def send(self, count: int = 1, *, sender: str = "a", raw: bytes | None = None, skip: int = 0, **keys) -> list:
        """Send datagrams, one a period, with these keys; return what the source makes of them."""
        seen = []
        for _ in range(count):
            self.clock.wait_until(self.clock.now() + PERIOD_S)
            self.seq += 1 + skip
            told = {
                "schema": SCHEMA,
                "seq": self.seq,
                "stamp": self.clock.now() + AHEAD_S,
                "position": [0.1, 0.2, 0.3 + 1e-4 * self.seq],
            }
            told |= keys
            payload = json.dumps({key: value for key, value in told.items() if value is not ...}).encode()
            self.wire.put(payload if raw is None else raw, sender)
            while (one := self.stream.read(0.0)) is not None:
                seen.append(one)
        return seen

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages by what became of them."""
        return {str(what): count for what, count in self.stream.ledger.total.items()}
