"""Question and answer on one bus: what is not exactly the answer to this question, in time, is refused."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import chain
from typing import TypeVar

from bodyschema.interfaces.protocols import Clock

from .model import Layout, Model, Register
from .packets import Garbled, Packets, Status
from .port import Port

BITS_PER_BYTE = 10
SLOWEST_DELAY_S = 510e-6  # Return Delay Time at its largest
HOST_MARGIN_S = 3e-3  # the operating system's part of an answer's delay
TOO_EARLY = 0.9  # an answer within this share of its time on the wire is another question's
LONGEST_NOISE_S = 0.25
QUIET_S = 2e-3
OWED_S = 0.06  # how late an answer may come: more than the 50 ms for which busy USB hosts were seen to hold bytes back
ASKED_LATELY = 4  # questions whose number of bytes is not asked for again at once
MOST_SPARE = 10  # bytes: from the end of a reading's block to that of the documented registers of the X and P series

Taken = TypeVar("Taken")
Take = Callable[[bytearray, int], Taken | None]
"""Takes a packet that begins somewhere in what was received; None when it is not complete."""


class Trouble(StrEnum):
    """What was wrong with an exchange."""

    TIMEOUT = "no answer"
    GARBLED = "a garbled answer"
    FOREIGN = "another servo's answer"
    WRONG_LENGTH = "an answer of another length"
    EARLY = "an answer before it could have come"
    REFUSED = "an error in answer"
    NOISE = "noise while nobody was asked"


@dataclass(frozen=True, slots=True)
class Request:
    """A question, and who answers it.

    Attributes:
        packet: the bytes to send for so many bytes of data from each.
        ids: who answers, in this order.
        size: bytes of data that are wanted from each.
        protocol: version of the make's protocol.
        spare: how many bytes more it may ask for, to tell its answers from late ones to an earlier question.
        is_fast: all answer in one packet.
    """

    packet: Callable[[int], bytes]
    ids: tuple[int, ...]
    size: int
    protocol: int
    spare: int = 0
    is_fast: bool = False


@dataclass(frozen=True, slots=True)
class Answer:
    """One servo's answer, between which times [s] it began to answer, and when it was asked [s]."""

    status: Status
    earliest: float
    latest: float
    asked: float


@dataclass(frozen=True, slots=True)
class Exchange:
    """What came of a question: the answers up to the first trouble, or all of them."""

    answers: tuple[Answer, ...]
    trouble: Trouble | None = None
    culprit: int | None = None


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


class Owed:
    """Answers that did not come in time. Each may still come, and must not pass for the answer to a later question.

    An answer is known by its servo and its number of bytes. So a servo that owes one is asked for a byte more.
    """

    def __init__(self) -> None:
        """Nothing is owed."""
        self._until: dict[tuple[int, int, int], float] = {}

    @property
    def protocols(self) -> set[int]:
        """Versions of the protocol in which something is owed."""
        return {protocol for protocol, _, _ in self._until}

    def add(self, protocol: int, id: int, size: int, until: float) -> None:
        """A servo's answer with so many bytes may come until then [s]."""
        self._until[protocol, id, size] = until

    def take(self, protocol: int, status: Status) -> bool:
        """Return True when this answer was owed; then it is owed no more."""
        return self._until.pop((protocol, status.id, len(status.data)), None) is not None

    def size_for(self, request: Request, now: float, lately: Collection[int]) -> int | None:
        """Return the smallest number of bytes to ask for that no owed answer of the same servos has.

        One that is not in `lately`, if there is one.
        """
        if self._until:
            self._until = {answer: until for answer, until in self._until.items() if until > now}
        sizes = range(request.size, request.size + request.spare + 1)
        free = (size for size in sizes if not self._alike(request, size))
        first = next(free, None)
        return next((size for size in chain([first], free) if size not in lately), first)

    def until(self, request: Request) -> float:
        """Return when no answer that looks like one to `request` can come any more [s]."""
        return max(self._alike(request, request.size))

    def _alike(self, request: Request, size: int) -> list[float]:
        answers = ((request.protocol, id, size) for id in request.ids)
        return [self._until[answer] for answer in answers if answer in self._until]


class Bus(ABC):
    """Servos behind one port. A late answer is never taken for that to a later question.

    A servo that did not answer in time is asked for another number of bytes from then on, until its answer can come no
    more. Where only the number of bytes tells answers apart, none of five questions in a row asks for the same: an
    answer that comes twice is not taken for that to one of the next. After bytes that cannot be understood the line has
    to fall silent before the next question.

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
        self._sent = self._free_s = 0.0
        self._owed = Owed()
        self._asked_size = self._question_size = 0
        self._asked_lately: dict[tuple[int, ...], deque[int]] = {}

    @staticmethod
    @abstractmethod
    def packets_of(protocol: int) -> Packets:
        """How to speak a version of the protocol."""

    def close(self) -> None:
        """Give the port free."""
        self._port.close()

    def read_request(self, model: Model, id: int, register: Register) -> Request:
        """Ask one servo for part of its control table."""
        packets, spare = self.packets_of(model.protocol), spare_after(model.layout, register)
        return Request(lambda n: packets.read(id, register.address, n), (id,), register.size, model.protocol, spare)

    def is_weak(self, request: Request) -> bool:
        """Return True when a wrong answer may pass the checksum, or a late one go unnoticed."""
        return self.packets_of(request.protocol).is_weak

    def write(self, model: Model, id: int, register: Register, data: bytes) -> Exchange:
        """Write a register."""
        return self.tell(model.protocol, self.packets_of(model.protocol).write(id, register.address, data), id)

    def ping(self, model: Model, id: int) -> Exchange:
        """Ask a servo whether it is there."""
        packets = self.packets_of(model.protocol)
        return self.ask(Request(lambda _: packets.ping(id), (id,), packets.ping_size, model.protocol))

    def ask(self, request: Request) -> Exchange:
        """Send it and wait for its answers."""
        self.send(request)
        return self.collect(request)

    def send(self, request: Request) -> None:
        """Send it. Where its answers would look like late ones, wait first until those can come no more."""
        is_weak = self.is_weak(request)
        lately = self._asked_lately.setdefault(request.ids, deque(maxlen=ASKED_LATELY)) if is_weak else ()
        size = self._owed.size_for(request, self._clock.now(), lately)
        if size is None and is_weak:
            self._wait_out(self._owed.until(request))
        self._asked_size = request.size if size is None else size
        if is_weak:
            self._asked_lately[request.ids].append(self._asked_size)
        packet = request.packet(self._asked_size)
        self._question_size = len(packet)
        self._port.flush()
        self._sent = max(self._clock.now(), self._free_s)
        self._port.write(packet)

    def collect(self, request: Request) -> Exchange:
        """Wait for the answers to what was sent last."""
        exchange = self._collect(request)
        self.counts.add(exchange.trouble)
        if exchange.trouble not in (None, Trouble.TIMEOUT):
            self.settle()
        return exchange

    def tell(self, protocol: int, packet: bytes, id: int) -> Exchange:
        """Send an instruction that is answered without data, or, as its status return level says, not at all."""
        return self.ask(Request(lambda _: packet, (id,), 0, protocol))

    def announce(self, packet: bytes) -> None:
        """Send an instruction that nobody answers. The next question comes after it on the wire."""
        self._free_s = max(self._clock.now(), self._free_s) + len(packet) * self._byte_s
        self._port.write(packet)

    def listen(self, until: float) -> bool:
        """Wait; False when something came that was not owed: what came before is not to be trusted."""
        received, at = bytearray(), 0
        while data := self._port.receive(until):
            received += data
            at += self._owed_size(received, at)
            if self._clock.now() >= until:  # where noise comes without end, something is always there
                break
        if at == len(received):
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

    def _wait_out(self, until: float) -> None:
        while self._port.receive(until) and self._clock.now() < until:
            pass

    def _owed_size(self, received: bytearray, at: int) -> int:
        """Return how many bytes from `at` on are answers that were owed. Then they are owed no more."""
        begun, found = at, True
        while found:
            found = False
            for protocol in self._owed.protocols:
                with suppress(Garbled):
                    status = self.packets_of(protocol).take(received, at)
                    if status is not None and self._owed.take(protocol, status):
                        found, at = True, at + status.size
        return at - begun

    def _deadline(self, request: Request) -> float:
        """Return when all answers are there: after their time on the wire, and what adapter and system may add."""
        overhead = self.packets_of(request.protocol).overhead
        wire = self._question_size + len(request.ids) * (overhead + self._asked_size)
        delays = sum(self.return_delay_s.get(id, SLOWEST_DELAY_S) for id in request.ids)
        return self._sent + wire * self._byte_s + delays + 2 * self._latency_s + HOST_MARGIN_S

    def _collect(self, request: Request) -> Exchange:
        """Hear the servos to the last, also where one is missing. Only answers before that one count."""
        take, inbox = self.packets_of(request.protocol).take, self._inbox(request)
        answers, missing, waiting = list[Answer](), list[int](), list(request.ids)
        expected_s, trouble = self._sent + self._question_size * self._byte_s, None
        while waiting and trouble is None:
            status, trouble = self._next(inbox, take)
            if status is None:
                continue
            if status.id in waiting:
                while waiting[0] != status.id:
                    missing.append(waiting.pop(0))
            trouble = self._doubt(request, waiting[0], status, inbox.own + status.size)
            if trouble is None:
                expected_s += self.return_delay_s.get(waiting.pop(0), 0.0)
                if not missing:
                    answers.append(self._timed(request, status, expected_s, inbox, inbox.at))
                expected_s += status.size * self._byte_s
                inbox.at += status.size
        if trouble is None and inbox.at + self._owed_size(inbox.received, inbox.at) < len(inbox.received):
            trouble = Trouble.GARBLED
        if missing and trouble is None:
            trouble = Trouble.TIMEOUT
        self._note_owed(request, missing + waiting)
        culprits = missing + waiting if trouble is Trouble.TIMEOUT else waiting
        return Exchange(tuple(answers), trouble, next(iter(culprits), None))

    def _next(self, inbox: Inbox, take: Take[Taken]) -> tuple[Taken | None, Trouble | None]:
        """Return the next answer that is not an owed one, or why there is none."""
        try:
            while True:
                late = self._owed_size(inbox.received, inbox.at)
                inbox.at, inbox.late = inbox.at + late, inbox.late + late
                taken = take(inbox.received, inbox.at)
                if taken is not None:
                    return taken, None
                if not inbox.fill():
                    return None, inbox.silence()
        except Garbled:
            return None, Trouble.GARBLED

    def _note_owed(self, request: Request, ids: Iterable[int]) -> None:
        for id in ids:
            self._owed.add(request.protocol, id, self._asked_size, self._clock.now() + OWED_S)

    def _doubt(self, request: Request, id: int, status: Status, answered_bytes: int) -> Trouble | None:
        if status.id != id:
            return Trouble.FOREIGN
        if status.error & self.packets_of(request.protocol).refusals:
            return Trouble.REFUSED
        if len(status.data) != self._asked_size:
            return Trouble.WRONG_LENGTH
        wire_s = (self._question_size + answered_bytes) * self._byte_s
        if self._clock.now() - self._sent < TOO_EARLY * wire_s:
            return Trouble.EARLY
        return None

    def _timed(self, request: Request, status: Status, earliest: float, inbox: Inbox, at: int) -> Answer:
        """When the packet at `at` was begun: all that came with it and after it was on the wire by the arrival."""
        latest = inbox.arrived - (len(inbox.received) - at) * self._byte_s
        wanted = Status(status.id, status.error, status.data[: request.size], status.size)
        return Answer(wanted, min(earliest, latest), latest, self._sent)

    def _inbox(self, request: Request) -> Inbox:
        return Inbox(self._port, self._clock, self._deadline(request))


class Inbox:
    """What has come in answer to a question.

    Attributes:
        received: all of it.
        at: so many bytes of it are understood.
        late: so many of those were answers to earlier questions.
        arrived: when the last of it came [s].
    """

    def __init__(self, port: Port, clock: Clock, deadline: float) -> None:
        self._port, self._clock, self._deadline = port, clock, deadline
        self.received = bytearray()
        self.at = self.late = 0
        self.arrived = 0.0

    @property
    def own(self) -> int:
        """Bytes that are understood and answer this question."""
        return self.at - self.late

    def fill(self) -> bool:
        """Wait for more; False when nothing comes in time."""
        data = self._port.receive(self._deadline)
        self.received += data
        self.arrived = self._clock.now()
        return bool(data)

    def silence(self) -> Trouble:
        """What it means that nothing more comes."""
        return Trouble.GARBLED if len(self.received) > self.at else Trouble.TIMEOUT


def spare_after(layout: Layout, register: Register) -> int:
    """Return how many bytes after a register may be read with it."""
    return min(MOST_SPARE, layout.size - register.end)
