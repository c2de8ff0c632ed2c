"""Request and answer on one bus. Anything that is not exactly the answer to the request, in time, is rejected."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import chain
from typing import TypeVar

from bodyschema.drivers.echo import BITS_PER_BYTE, HOST_S, Port
from bodyschema.interfaces.protocols import Clock

from .model import Layout, Model, Register
from .packets import Garbled, Packets, Status

RETURN_DELAY_UNIT_S = 2e-6
LARGEST_RETURN_DELAY_S = 0xFF * RETURN_DELAY_UNIT_S


class _Settings:
    # an answer within this share of its time on the wire belongs to another request
    too_early: float = 0.9
    quiet_s: float = 2e-3
    # longest delay of a late answer: above the 50 ms for which busy USB hosts were seen to hold bytes back
    overdue_s: float = 0.06
    # number of recent requests whose size is avoided
    recent_requests: int = 4
    longest_noise_s: float = 0.25  # how long a bus is waited for to fall quiet
    # bytes: from the end of a reading's block to that of the documented registers of the X and P series
    max_spare_bytes: int = 10


Taken = TypeVar("Taken")
Take = Callable[[bytearray, int], Taken | None]
"""Takes a packet that begins somewhere in what was received; None when it is not complete."""


class Trouble(StrEnum):
    """Kinds of failed exchanges."""

    TIMEOUT = "no answer"
    GARBLED = "a garbled answer"
    FOREIGN = "another servo's answer"
    WRONG_LENGTH = "an answer of another length"
    EARLY = "an answer before it could have come"
    REFUSED = "an error in answer"
    NOISE = "noise while no request was pending"


@dataclass(frozen=True, slots=True)
class Request:
    """A request and the servos that answer it."""

    packet: Callable[[int], bytes]  # returns the bytes to send for a number of data bytes per servo
    ids: tuple[int, ...]  # servos that answer, in this order
    size: int  # data bytes wanted from each
    protocol: int  # version of the vendor's protocol
    spare: int = 0  # extra bytes that may be requested, to distinguish its answers from late ones to an earlier one
    is_fast: bool = False  # all answer in one packet


@dataclass(frozen=True, slots=True)
class Answer:
    """One servo's answer, the earliest and latest start of this answer [s], and the time of the request [s]."""

    status: Status
    earliest: float
    latest: float
    request_t: float


@dataclass(frozen=True, slots=True)
class Exchange:
    """Result of a request: the answers up to the first trouble, or all of them."""

    answers: tuple[Answer, ...]
    trouble: Trouble | None = None
    failed_id: int | None = None


@dataclass
class Counts:
    """Number of exchanges and of troubles on a bus."""

    exchanges: int = 0
    troubles: dict[Trouble, int] = field(default_factory=dict)

    def add(self, trouble: Trouble | None) -> None:
        self.exchanges += 1
        if trouble is not None:
            self.troubles[trouble] = self.troubles.get(trouble, 0) + 1


class OverdueAnswers:
    """Overdue answers. Each may still arrive, and must not be taken for the answer to a later request.

    An answer is identified by its servo and its number of bytes. So a servo with an overdue answer is asked for one
    byte more.
    """

    def __init__(self) -> None:
        self._until: dict[tuple[int, int, int], float] = {}

    @property
    def protocols(self) -> set[int]:
        """Versions of the protocol with overdue answers."""
        return {protocol for protocol, _, _ in self._until}

    def add(self, protocol: int, id: int, size: int, until: float) -> None:
        """Note that a servo's answer with `size` bytes may arrive until `until` [s]."""
        self._until[protocol, id, size] = until

    def take(self, protocol: int, status: Status) -> bool:
        """Return True and forget the answer if it was overdue."""
        return self._until.pop((protocol, status.id, len(status.data)), None) is not None

    def size_for(self, request: Request, now: float, recent_sizes: Collection[int]) -> int | None:
        """Return the smallest number of bytes to request that no overdue answer of the same servos has.

        Prefer one that is not in `recent_sizes`. Return None if every size is taken.
        """
        if self._until:
            self._until = {answer: until for answer, until in self._until.items() if until > now}
        sizes = range(request.size, request.size + request.spare + 1)
        free = (size for size in sizes if not self._similar_until(request, size))
        first = next(free, None)
        return next((size for size in chain([first], free) if size not in recent_sizes), first)

    def until(self, request: Request) -> float:
        """Return the time after which no overdue answer can look like one to `request` [s]."""
        return max(self._similar_until(request, request.size))

    def _similar_until(self, request: Request, size: int) -> list[float]:
        answers = ((request.protocol, id, size) for id in request.ids)
        return [self._until[answer] for answer in answers if answer in self._until]


class Bus(ABC):
    """Servos behind one port. A late answer is never taken for the answer to a later request.

    After a time-out a servo is asked for another number of bytes until its late answer can no longer arrive. If only
    the number of bytes distinguishes answers, no two of five consecutive requests use the same one, so that an answer
    that arrives twice is not taken for the answer to one of the next. After unintelligible bytes the line has to be
    silent before the next request.

    Attributes:
        return_delay_s: return delay by ID; the longest delay is assumed for unknown ones.
        counts: number of exchanges and of troubles.
    """

    def __init__(self, name: str, port: Port, clock: Clock, latency_s: float) -> None:
        """Use an open port, whose adapter holds bytes back for `latency_s` at most."""
        self.name, self.return_delay_s, self.counts = name, dict[int, float](), Counts()
        self._port, self._clock, self._latency_s = port, clock, latency_s
        self._byte_s = BITS_PER_BYTE / port.baud
        self._sent = self._free_s = 0.0
        self._overdue = OverdueAnswers()
        self._requested_size = self._request_bytes = 0
        self._recent_sizes: dict[tuple[int, ...], deque[int]] = {}

    @staticmethod
    @abstractmethod
    def packets_of(protocol: int) -> Packets:
        """Return the packet codec of a version of the protocol."""

    def close(self) -> None:
        """Release the port."""
        self._port.close()

    def read_request(self, model: Model, id: int, register: Register) -> Request:
        """Return a request of part of one servo's control table."""
        packets, spare = self.packets_of(model.protocol), spare_after(model.layout, register)
        return Request(lambda n: packets.read(id, register.address, n), (id,), register.size, model.protocol, spare)

    def is_weak(self, request: Request) -> bool:
        """Return True if a wrong answer may pass the checksum, or a late one go unnoticed."""
        return self.packets_of(request.protocol).is_weak

    def write(self, model: Model, id: int, register: Register, data: bytes) -> Exchange:
        return self.tell(model.protocol, self.packets_of(model.protocol).write(id, register.address, data), id)

    def ping(self, model: Model, id: int) -> Exchange:
        packets = self.packets_of(model.protocol)
        return self.ask(Request(lambda _: packets.ping(id), (id,), packets.ping_size, model.protocol))

    def ask(self, request: Request) -> Exchange:
        """Send a request and wait for its answers."""
        self.send(request)
        return self.collect(request)

    def send(self, request: Request) -> None:
        """Send a request. If overdue answers could pass for its answers, wait first until they can no longer arrive."""
        is_weak = self.is_weak(request)
        recent_sizes = (
            self._recent_sizes.setdefault(request.ids, deque(maxlen=_Settings.recent_requests)) if is_weak else ()
        )
        size = self._overdue.size_for(request, self._clock.now(), recent_sizes)
        if size is None and is_weak:
            until = self._overdue.until(request)
            while self._port.receive(until) and self._clock.now() < until:
                pass
        self._requested_size = request.size if size is None else size
        if is_weak:
            self._recent_sizes[request.ids].append(self._requested_size)
        packet = request.packet(self._requested_size)
        self._request_bytes = len(packet)
        self._port.flush()
        self._sent = max(self._clock.now(), self._free_s)
        self._port.write(packet)

    def collect(self, request: Request) -> Exchange:
        """Wait for the answers to the last request."""
        exchange = self._collect(request)
        self.counts.add(exchange.trouble)
        if exchange.trouble not in (None, Trouble.TIMEOUT):
            self.settle()
        return exchange

    def tell(self, protocol: int, packet: bytes, id: int) -> Exchange:
        """Send an instruction that is answered without data, or not at all, depending on the status return level."""
        return self.ask(Request(lambda _: packet, (id,), 0, protocol))

    def announce(self, packet: bytes) -> None:
        """Send an instruction without an answer. The next request follows it on the wire."""
        self._free_s = max(self._clock.now(), self._free_s) + len(packet) * self._byte_s
        self._port.write(packet)

    def listen(self, until: float) -> bool:
        """Wait until `until`. Return False if other than overdue bytes arrived: distrust earlier answers then."""
        received, at = bytearray(), 0
        while data := self._port.receive(until):
            received += data
            at += self._overdue_size(received, at)
            if self._clock.now() >= until:  # with endless noise there is always something to receive
                break
        if at == len(received):
            return True
        self.counts.add(Trouble.NOISE)
        self.settle()
        return False

    def settle(self) -> None:
        """Wait until the line has been silent for a while."""
        quiet_s = max(_Settings.quiet_s, 2 * self._latency_s)
        end = self._clock.now() + _Settings.longest_noise_s
        while self._clock.now() < end and self._port.receive(self._clock.now() + quiet_s):
            pass

    def _overdue_size(self, received: bytearray, at: int) -> int:
        """Return how many bytes from `at` on are overdue answers, and forget these."""
        begun, found = at, True
        while found:
            found = False
            for protocol in self._overdue.protocols:
                with suppress(Garbled):
                    status = self.packets_of(protocol).take(received, at)
                    if status is not None and self._overdue.take(protocol, status):
                        found, at = True, at + status.size
        return at - begun

    def _deadline(self, request: Request) -> float:
        """Return the deadline of all answers: their time on the wire, and the delays of adapter and system."""
        overhead = self.packets_of(request.protocol).overhead
        wire = self._request_bytes + len(request.ids) * (overhead + self._requested_size)
        delays = sum(self.return_delay_s.get(id, LARGEST_RETURN_DELAY_S) for id in request.ids)
        return self._sent + wire * self._byte_s + delays + 2 * self._latency_s + HOST_S

    def _collect(self, request: Request) -> Exchange:
        """Receive the answers of all servos, even if one is missing. Only answers before the missing one count."""
        take, inbox = self.packets_of(request.protocol).take, self._inbox(request)
        answers, missing, waiting = list[Answer](), list[int](), list(request.ids)
        expected_s, trouble = self._sent + self._request_bytes * self._byte_s, None
        while waiting and trouble is None:
            status, trouble = self._next(inbox, take)
            if status is None:
                continue
            if status.id in waiting:
                while waiting[0] != status.id:
                    missing.append(waiting.pop(0))
            trouble = self._mismatch(request, waiting[0], status, inbox.own + status.size)
            if trouble is None:
                expected_s += self.return_delay_s.get(waiting.pop(0), 0.0)
                if not missing:
                    answers.append(self._timed(request, status, expected_s, inbox, inbox.at))
                expected_s += status.size * self._byte_s
                inbox.at += status.size
        if trouble is None and inbox.at + self._overdue_size(inbox.received, inbox.at) < len(inbox.received):
            trouble = Trouble.GARBLED
        if missing and trouble is None:
            trouble = Trouble.TIMEOUT
        self._note_overdue(request, missing + waiting)
        culprits = missing + waiting if trouble is Trouble.TIMEOUT else waiting
        return Exchange(tuple(answers), trouble, next(iter(culprits), None))

    def _next(self, inbox: Inbox, take: Take[Taken]) -> tuple[Taken | None, Trouble | None]:
        """Return the next answer that is not overdue, or the reason why it is missing."""
        try:
            while True:
                late = self._overdue_size(inbox.received, inbox.at)
                inbox.at, inbox.late = inbox.at + late, inbox.late + late
                taken = take(inbox.received, inbox.at)
                if taken is not None:
                    return taken, None
                if not inbox.fill():
                    return None, inbox.silence()
        except Garbled:
            return None, Trouble.GARBLED

    def _note_overdue(self, request: Request, ids: Iterable[int]) -> None:
        for id in ids:
            self._overdue.add(request.protocol, id, self._requested_size, self._clock.now() + _Settings.overdue_s)

    def _mismatch(self, request: Request, id: int, status: Status, answered_bytes: int) -> Trouble | None:
        if status.id != id:
            return Trouble.FOREIGN
        if status.error & self.packets_of(request.protocol).refusals:
            return Trouble.REFUSED
        if len(status.data) != self._requested_size:
            return Trouble.WRONG_LENGTH
        wire_s = (self._request_bytes + answered_bytes) * self._byte_s
        if self._clock.now() - self._sent < _Settings.too_early * wire_s:
            return Trouble.EARLY
        return None

    def _timed(self, request: Request, status: Status, earliest: float, inbox: Inbox, at: int) -> Answer:
        """Return the answer with bounds of its start.

        The latest start follows from the bytes that came with or after it: all were on the wire before the arrival.
        """
        latest = inbox.arrived - (len(inbox.received) - at) * self._byte_s
        trimmed = Status(status.id, status.error, status.data[: request.size], status.size)
        return Answer(trimmed, min(earliest, latest), latest, self._sent)

    def _inbox(self, request: Request) -> Inbox:
        return Inbox(self._port, self._clock, self._deadline(request))


class Inbox:
    """Bytes received in answer to a request.

    Attributes:
        at: number of bytes parsed.
        late: number of those in answers to earlier requests.
        arrived: time of the last arrival [s].
    """

    def __init__(self, port: Port, clock: Clock, deadline: float) -> None:
        self._port, self._clock, self._deadline = port, clock, deadline
        self.received = bytearray()
        self.at = self.late = 0
        self.arrived = 0.0

    @property
    def own(self) -> int:
        """Parsed bytes that answer this request."""
        return self.at - self.late

    def fill(self) -> bool:
        """Wait for more. Return False if nothing arrives in time."""
        data = self._port.receive(self._deadline)
        self.received += data
        self.arrived = self._clock.now()
        return bool(data)

    def silence(self) -> Trouble:
        """Return the trouble to report if nothing more arrives."""
        return Trouble.GARBLED if len(self.received) > self.at else Trouble.TIMEOUT


def spare_after(layout: Layout, register: Register) -> int:
    """Return how many bytes after a register may be read together with it."""
    return min(_Settings.max_spare_bytes, layout.size - register.end)
