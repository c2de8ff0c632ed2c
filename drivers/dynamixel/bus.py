"""Question and answer on one bus: whatever is not exactly the answer to this question, in time, is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from interfaces.protocols import Clock

from .packets import PACKETS2, Garbled, Status, Version, packets_of
from .port import Port

BITS_PER_BYTE = 10
SLOWEST_DELAY_S = 510e-6  # Return Delay Time at its largest
HOST_MARGIN_S = 3e-3  # the operating system's part of an answer's delay
TOO_EARLY = 0.9  # an answer within this share of its time on the wire is another question's
LONGEST_NOISE_S = 0.25
QUIET_S = 2e-3
OWED_S = 0.06  # how long an answer of Protocol 1.0 may be late: in Protocol 2.0 the servo's clock tells


# Errors of the question; the other bits tell of the servo's health. (e-Manual, status packets)
REFUSALS = {1: 0x58, 2: 0x7F}
FAST_HEADER = 8  # bytes before the first servo's part


class Trouble(StrEnum):
    """What was wrong with an exchange."""

    TIMEOUT = "no answer"
    GARBLED = "a garbled answer"
    FOREIGN = "another servo's answer"
    WRONG_LENGTH = "an answer of another length"
    EARLY = "an answer before it could have come"
    REFUSED = "an error in answer"
    NOISE = "noise while nobody was asked"


OWING = (Trouble.TIMEOUT, Trouble.FOREIGN, Trouble.EARLY, Trouble.WRONG_LENGTH)


@dataclass(frozen=True, slots=True)
class Request:
    """A question, and who answers it.

    Attributes:
        packet: the bytes to send.
        ids: who answers, in this order.
        size: bytes of data that each gives.
        protocol: 1 or 2.
        is_fast: all answer in one packet.
    """

    packet: bytes
    ids: tuple[int, ...]
    size: int
    protocol: Version
    is_fast: bool = False


@dataclass(frozen=True, slots=True)
class Answer:
    """One servo's answer, and between which times [s] it began to answer."""

    status: Status
    earliest: float
    latest: float


@dataclass(frozen=True, slots=True)
class Exchange:
    """What came of a question: the answers up to the first trouble, or all of them."""

    answers: tuple[Answer, ...]
    trouble: Trouble | None = None
    culprit: int | None = None


def read_request(protocol: Version, id: int, address: int, size: int) -> Request:
    """Ask one servo for part of its control table."""
    packet = packets_of(protocol).read(id, address, size)
    return Request(packet, (id,), size, protocol)


def sync_request(ids: Sequence[int], address: int, size: int, *, fast: bool) -> Request:
    """Ask several servos of Protocol 2.0 for the same part."""
    return Request(PACKETS2.sync_read(ids, address, size, fast=fast), tuple(ids), size, 2, fast)


@dataclass
class Counts:
    """How the exchanges of a bus went."""

    exchanges: int = 0
    troubles: dict[Trouble, int] = field(default_factory=dict)

    def add(self, trouble: Trouble | None) -> None:
        """One more."""
        self.exchanges += 1
        if trouble is not None:
            self.troubles[trouble] = self.troubles.get(trouble, 0) + 1


class Bus:
    """Servos behind one port. After anything doubtful the line has to fall silent before the next question.

    Attributes:
        return_delay_s: by ID, how long each waits before it answers; unknown ones may need the longest time.
        counts: how the exchanges went.
    """

    def __init__(self, name: str, port: Port, clock: Clock, latency_s: float) -> None:
        """A bus at an open port.

        Args:
            latency_s: how long the adapter may keep bytes back.
        """
        self.name, self.return_delay_s, self.counts = name, dict[int, float](), Counts()
        self._port, self._clock, self._latency_s = port, clock, latency_s
        self._byte_s = BITS_PER_BYTE / port.baud
        self._sent = 0.0

    def close(self) -> None:
        """Give the port free."""
        self._port.close()

    def ask(self, request: Request) -> Exchange:
        """Send it and wait for its answers."""
        self.send(request)
        return self.collect(request)

    def send(self, request: Request) -> None:
        """Send it."""
        self._port.flush()
        self._sent = self._clock.now()
        self._port.write(request.packet)

    def collect(self, request: Request) -> Exchange:
        """Wait for the answers to what was sent last."""
        exchange = self._collect_fast(request) if request.is_fast else self._collect(request)
        self.counts.add(exchange.trouble)
        if exchange.trouble in OWING and request.protocol == 1:
            self._await_owed(packets_of(1).overhead + request.size)
        if exchange.trouble is not None:
            self.settle()
        return exchange

    def tell(self, protocol: Version, packet: bytes, id: int) -> Exchange:
        """Send an instruction that is answered without data, or, as its status return level says, not at all."""
        return self.ask(Request(packet, (id,), 0, protocol))

    def listen(self, until: float) -> bool:
        """Wait; False when something came though nobody was asked: what came before is not to be trusted."""
        if not self._port.receive(until):
            return True
        self.counts.add(Trouble.NOISE)
        self.settle()
        return False

    def settle(self) -> None:
        """Wait until the line has been silent for a while."""
        quiet_s = max(QUIET_S, 2 * self._latency_s)
        end = self._clock.now() + LONGEST_NOISE_S
        while self._clock.now() < end and self._port.receive(self._clock.now() + quiet_s):
            pass

    def _await_owed(self, size: int) -> None:
        """Wait for an answer that may still come, which would be taken for that to the next question."""
        end = self._clock.now() + OWED_S
        while size > 0 and (data := self._port.receive(end)):
            size -= len(data)

    def _deadline(self, request: Request) -> float:
        overhead = packets_of(request.protocol).overhead
        wire = len(request.packet) + len(request.ids) * (overhead + request.size)
        delays = sum(self.return_delay_s.get(id, SLOWEST_DELAY_S) for id in request.ids)
        return self._sent + wire * self._byte_s + delays + 2 * self._latency_s + HOST_MARGIN_S

    def _collect(self, request: Request) -> Exchange:
        packets, inbox, at = packets_of(request.protocol), self._inbox(request), 0
        answers: list[Answer] = []
        expected_s = self._sent + len(request.packet) * self._byte_s
        for id in request.ids:
            try:
                while (status := packets.take(inbox.received, at)) is None:
                    if not inbox.fill():
                        return Exchange(tuple(answers), inbox.silence(at), id)
            except Garbled:
                return Exchange(tuple(answers), Trouble.GARBLED, id)
            trouble = self._doubt(request, id, status, at + status.size)
            if trouble is not None:
                return Exchange(tuple(answers), trouble, id)
            expected_s += self.return_delay_s.get(id, 0.0)
            answers.append(self._timed(status, expected_s, inbox, at))
            expected_s += status.size * self._byte_s
            at += status.size
        return Exchange(tuple(answers), Trouble.GARBLED if len(inbox.received) > at else None)

    def _collect_fast(self, request: Request) -> Exchange:
        inbox, count = self._inbox(request), len(request.ids)
        try:
            while (statuses := PACKETS2.take_fast(inbox.received, 0, count, request.size)) is None:
                if not inbox.fill():
                    return Exchange((), inbox.silence(0))
        except Garbled:
            return Exchange((), Trouble.GARBLED)
        answers: list[Answer] = []
        start_s = self._sent + len(request.packet) * self._byte_s + self.return_delay_s.get(request.ids[0], 0.0)
        at = FAST_HEADER
        for id, status in zip(request.ids, statuses, strict=True):
            trouble = self._doubt(request, id, status, FAST_HEADER + count * status.size)
            if trouble is not None:
                return Exchange(tuple(answers), trouble, id)
            answers.append(self._timed(status, start_s + at * self._byte_s, inbox, at))
            at += status.size
        return Exchange(tuple(answers), Trouble.GARBLED if len(inbox.received) > at else None)

    def _doubt(self, request: Request, id: int, status: Status, answered_bytes: int) -> Trouble | None:
        if status.id != id:
            return Trouble.FOREIGN
        if status.error & REFUSALS[request.protocol]:
            return Trouble.REFUSED
        if len(status.data) != request.size:
            return Trouble.WRONG_LENGTH
        wire_s = (len(request.packet) + answered_bytes) * self._byte_s
        if self._clock.now() - self._sent < TOO_EARLY * wire_s:
            return Trouble.EARLY
        return None

    def _timed(self, status: Status, earliest: float, inbox: _Inbox, at: int) -> Answer:
        """When the packet at `at` was begun: all that came with it and after it was on the wire by the arrival."""
        latest = inbox.arrived - (len(inbox.received) - at) * self._byte_s
        return Answer(status, min(earliest, latest), latest)

    def _inbox(self, request: Request) -> _Inbox:
        return _Inbox(self._port, self._clock, self._deadline(request))


class _Inbox:
    """What has come in answer to a question."""

    def __init__(self, port: Port, clock: Clock, deadline: float) -> None:
        self._port, self._clock, self._deadline = port, clock, deadline
        self.received = bytearray()
        self.arrived = 0.0

    def fill(self) -> bool:
        """Wait for more; False when nothing comes in time."""
        data = self._port.receive(self._deadline)
        self.received += data
        self.arrived = self._clock.now()
        return bool(data)

    def silence(self, at: int) -> Trouble:
        """What it means that nothing more comes, all before `at` being understood."""
        return Trouble.GARBLED if len(self.received) > at else Trouble.TIMEOUT
