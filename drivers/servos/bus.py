"""Question and answer on one bus: whatever is not exactly the answer to this question, in time, is refused."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import StrEnum

from interfaces.protocols import Clock

from .model import Model, Register
from .packets import Garbled, Packets, Status
from .port import Port

BITS_PER_BYTE = 10
SLOWEST_DELAY_S = 510e-6  # Return Delay Time at its largest
HOST_MARGIN_S = 3e-3  # the operating system's part of an answer's delay
TOO_EARLY = 0.9  # an answer within this share of its time on the wire is another question's
LONGEST_NOISE_S = 0.25
QUIET_S = 2e-3
OWED_S = 0.06  # how long an answer may be late where no servo's clock tells


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
        protocol: version of the make's protocol.
        is_fast: all answer in one packet.
    """

    packet: bytes
    ids: tuple[int, ...]
    size: int
    protocol: int
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


class Bus(ABC):
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
        self._sent = self._free_s = 0.0

    @staticmethod
    @abstractmethod
    def packets_of(protocol: int) -> Packets:
        """How to speak a version of the protocol."""

    def close(self) -> None:
        """Give the port free."""
        self._port.close()

    def read_request(self, model: Model, id: int, register: Register) -> Request:
        """Ask one servo for part of its control table."""
        packet = self.packets_of(model.protocol).read(id, register.address, register.size)
        return Request(packet, (id,), register.size, model.protocol)

    def is_weak(self, request: Request) -> bool:
        """Whether a wrong answer may pass its checksum, or a late one go unnoticed."""
        return self.packets_of(request.protocol).is_weak

    def write(self, model: Model, id: int, register: Register, data: bytes) -> Exchange:
        """Write a register."""
        return self.tell(model.protocol, self.packets_of(model.protocol).write(id, register.address, data), id)

    def ping(self, model: Model, id: int) -> Exchange:
        """Ask a servo whether it is there."""
        packets = self.packets_of(model.protocol)
        return self.ask(Request(packets.ping(id), (id,), packets.ping_size, model.protocol))

    def ask(self, request: Request) -> Exchange:
        """Send it and wait for its answers."""
        self.send(request)
        return self.collect(request)

    def send(self, request: Request) -> None:
        """Send it."""
        self._port.flush()
        self._sent = max(self._clock.now(), self._free_s)
        self._port.write(request.packet)

    def collect(self, request: Request) -> Exchange:
        """Wait for the answers to what was sent last."""
        exchange = self._collect(request)
        self.counts.add(exchange.trouble)
        if exchange.trouble in OWING and self.is_weak(request):
            owing = len(request.ids) - len(exchange.answers)
            self._await_owed(owing * (self.packets_of(request.protocol).overhead + request.size))
        if exchange.trouble is not None:
            self.settle()
        return exchange

    def tell(self, protocol: int, packet: bytes, id: int) -> Exchange:
        """Send an instruction that is answered without data, or, as its status return level says, not at all."""
        return self.ask(Request(packet, (id,), 0, protocol))

    def announce(self, packet: bytes) -> None:
        """Send an instruction that nobody answers. The next question comes after it on the wire."""
        self._free_s = max(self._clock.now(), self._free_s) + len(packet) * self._byte_s
        self._port.write(packet)

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
        overhead = self.packets_of(request.protocol).overhead
        wire = len(request.packet) + len(request.ids) * (overhead + request.size)
        delays = sum(self.return_delay_s.get(id, SLOWEST_DELAY_S) for id in request.ids)
        return self._sent + wire * self._byte_s + delays + 2 * self._latency_s + HOST_MARGIN_S

    def _collect(self, request: Request) -> Exchange:
        packets, inbox, at = self.packets_of(request.protocol), self._inbox(request), 0
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

    def _doubt(self, request: Request, id: int, status: Status, answered_bytes: int) -> Trouble | None:
        if status.id != id:
            return Trouble.FOREIGN
        if status.error & self.packets_of(request.protocol).refusals:
            return Trouble.REFUSED
        if len(status.data) != request.size:
            return Trouble.WRONG_LENGTH
        wire_s = (len(request.packet) + answered_bytes) * self._byte_s
        if self._clock.now() - self._sent < TOO_EARLY * wire_s:
            return Trouble.EARLY
        return None

    def _timed(self, status: Status, earliest: float, inbox: Inbox, at: int) -> Answer:
        """When the packet at `at` was begun: all that came with it and after it was on the wire by the arrival."""
        latest = inbox.arrived - (len(inbox.received) - at) * self._byte_s
        return Answer(status, min(earliest, latest), latest)

    def _inbox(self, request: Request) -> Inbox:
        return Inbox(self._port, self._clock, self._deadline(request))


class Inbox:
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
