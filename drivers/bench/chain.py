"""Servos on one wire, whatever their make: bytes in, bytes with times out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from functools import reduce
from operator import and_
from typing import Any, Generic, Protocol, TypeVar

from .device import Faults, OnlyAnswers, Reply, Sampling, byte_s, no_faults

FORGET_AFTER_S = 0.02  # half an instruction is forgotten after so long
BAUD_TOLERANCE = 0.03


class AnyServo(Protocol):
    """What a chain asks of a servo."""

    @property
    def id(self) -> int:
        """Its number on the bus."""
        ...

    @property
    def baud(self) -> int:
        """The rate at which it listens [bit/s]."""
        ...

    @property
    def return_delay_s(self) -> float:
        """How long it waits before it answers."""
        ...

    def angle(self, t: float) -> float:
        """Where its shaft is at `t` [rad]."""
        ...

    def reboot(self, t: float) -> None:
        """As by a power cycle."""
        ...


ServoT = TypeVar("ServoT", bound=AnyServo)


class ServoChain(OnlyAnswers, ABC, Generic[ServoT]):
    """Servos on one half-duplex wire.

    Where several are asked at once each waits for the end of the answer before its own, or for as long as that would
    have taken. Each takes its position when its turn comes. Servos with one ID talk at the same time: where their
    bytes differ, the zeros win.

    Attributes:
        servos: in the order of the cable.
        faults: what happens to the answers.
        samplings: by ID, when each told its position last.
        instructions: how many were understood.
    """

    overhead: int
    """Bytes of a status packet besides its data."""

    def __init__(self, servos: Iterable[ServoT], faults: Faults = no_faults) -> None:
        """A chain with its power on."""
        self.servos = list(servos)
        self.faults = faults
        self.samplings: dict[int, Sampling] = {}
        self.instructions = 0
        self._stream = bytearray()
        self._last_byte_s = 0.0
        self._byte_s = 0.0

    def servo(self, id: int) -> ServoT:
        """The first one of this ID; KeyError without one."""
        for servo in self.servos:
            if servo.id == id:
                return servo
        raise KeyError(id)

    def power_cycle(self, t: float) -> None:
        """All lose their power and get it back at `t`."""
        for servo in self.servos:
            servo.reboot(t)

    def send(self, data: bytes, t: float, baud: int) -> list[Reply]:
        """The host's `data`, whose first byte is on the wire at `t` [s] or when the wire is free; what is answered."""
        t = max(t, self._last_byte_s)
        if t - self._last_byte_s > FORGET_AFTER_S:
            self._stream.clear()
        before = len(self._stream)
        self._stream += data
        self._byte_s = byte_s(baud)
        self._last_byte_s = t + len(data) * self._byte_s
        found, done = self._instructions_in(self._stream)
        del self._stream[:done]
        replies: list[Reply] = []
        for instruction in found:
            self.instructions += 1
            heard = t + (instruction.end - before) * self._byte_s
            replies += self._answers(instruction, heard, baud)
        arriving = [self.faults(reply) for reply in replies]
        return sorted((reply for reply in arriving if reply.data), key=lambda reply: reply.start)

    @abstractmethod
    def _instructions_in(self, stream: bytearray) -> tuple[list[Any], int]:
        """All complete instructions in `stream`, and how many of its bytes need not be seen again."""

    @abstractmethod
    def _answers(self, instruction: Any, t: float, baud: int) -> list[Reply]:
        """What is answered to an instruction that was heard at `t`."""

    @abstractmethod
    def _read(self, servo: ServoT, address: int, size: int, t: float) -> tuple[int, bytes]:
        """Error and data of part of a control table at `t`."""

    @abstractmethod
    def _packet(self, servo: ServoT, id: int, error: Any, params: bytes) -> bytes:
        """A status packet of a servo that was asked by this ID."""

    @abstractmethod
    def _will_answer(self, servo: ServoT, code: int) -> bool:
        """Whether the status return level lets it answer to such an instruction."""

    def _listening(self, baud: int) -> list[ServoT]:
        return [servo for servo in self.servos if abs((its := servo.baud) - baud) <= BAUD_TOLERANCE * its]

    def _together(
        self, servos: list[ServoT], t: float, act: Callable[[ServoT, float], tuple[Any, bytes]], code: int
    ) -> list[Reply]:
        """The answer of all servos of one ID, usually one; none where the status return level says so."""
        if not servos:
            return []
        start = t + min(servo.return_delay_s for servo in servos)
        id = servos[0].id  # whoever is given another one answers with that by which it was asked
        done = [(servo, act(servo, start)) for servo in servos]
        packets = [self._packet(servo, id, *told) for servo, told in done if self._will_answer(servo, code)]
        return [Reply(id, start, mixed(packets))] if packets else []

    def _in_turn(self, servos: list[ServoT], asked: list[tuple[int, int, int]], t: float, code: int) -> list[Reply]:
        replies: list[Reply] = []
        for id, address, size in asked:
            there = [s for s in servos if s.id == id]
            reply = self._together(there, t, lambda s, now, a=address, n=size: self._read(s, a, n, now), code)
            replies += reply
            t = (
                reply[0].start + len(reply[0].data) * self._byte_s
                if reply
                else t + (size + self.overhead) * self._byte_s
            )
        return replies


def mixed(packets: list[bytes]) -> bytes:
    """What is heard when all talk at the same time."""
    if len(packets) == 1:
        return packets[0]
    return bytes(reduce(and_, together) for together in zip(*packets, strict=False))
