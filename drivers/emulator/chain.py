"""Emulated servos on one wire, independent of the vendor: bytes in, timed bytes out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from functools import reduce
from operator import and_
from typing import Any, ClassVar, Generic, TypeVar

from bodyschema.drivers.servos.model import Model

from .device import Angle, AnswerOnlyDevice, Faults, Reply, Sampling, byte_s, no_faults


class _Settings:
    forget_after_s: float = 0.02  # an incomplete instruction is discarded after this pause
    baud_tolerance: float = 0.03  # relative: a servo hears a rate that is off by less


class EmulatedServo(ABC):
    """An emulated servo: a control table, and a shaft whose angle is given.

    Attributes:
        glitch_ticks: error of the encoder [ticks].
    """

    delay_unit_us: ClassVar[int]
    """Unit of the register of the return delay."""

    def __init__(self, model: Model, angle: Angle) -> None:
        """Start with an empty control table.

        Args:
            angle: shaft angle [rad] as a function of time [s]; 0 in the middle of its range, any number of turns.
        """
        self.model, self.glitch_ticks, self._angle = model, 0, angle
        self._memory = bytearray(model.layout.size)
        self._registered: tuple[int, bytes] | None = None  # a write that waits for ACTION

    @abstractmethod
    def __getitem__(self, name: str) -> int:
        """Return the value of a register."""

    @abstractmethod
    def __setitem__(self, name: str, value: int) -> None:
        """Write a register permanently, as the servo itself does, bypassing all locks."""

    @abstractmethod
    def write(self, address: int, data: bytes, t: float) -> object:
        """Write bytes of the control table as far as the servo allows it."""

    @abstractmethod
    def reboot(self, t: float) -> None:
        """Restart as after a power cycle."""

    @abstractmethod
    def fail(self, bits: int) -> None:
        """Report a hardware error until the servo is rebooted."""

    @property
    @abstractmethod
    def baud(self) -> int:
        """Baud rate of the servo [bit/s]."""

    @property
    def id(self) -> int:
        return self["id"]

    @property
    def return_delay_s(self) -> float:
        """Delay between instruction and answer [s]."""
        return self["return_delay"] * self.delay_unit_us * 1e-6

    def angle(self, t: float) -> float:
        """Return the shaft angle at `t` [rad]."""
        return self._angle(t)


ServoT = TypeVar("ServoT", bound=EmulatedServo)


class ServoChain(AnswerOnlyDevice, ABC, Generic[ServoT]):
    """Servos on one half-duplex wire.

    When several servos are asked at once, each waits for the end of the answer before its own, or for as long as that
    answer would have taken. Each samples its position when its turn comes. Servos that share an ID talk at the same
    time: where their bytes differ, the zeros win.
    """

    overhead: int
    """Bytes of a status packet apart from its data."""

    def __init__(self, servos: Iterable[ServoT], faults: Faults = no_faults) -> None:
        self.servos = list(servos)  # in the order of the cable
        self.faults = faults
        self.samplings: dict[int, Sampling] = {}  # by ID, time and angle of the last position sent
        self.instructions = 0
        self._stream = bytearray()
        self._last_byte_s = 0.0
        self._byte_s = 0.0

    def servo(self, id: int) -> ServoT:
        """Return the first servo with this ID; raise KeyError if it is missing."""
        for servo in self.servos:
            if servo.id == id:
                return servo
        raise KeyError(id)

    def power_cycle(self, t: float) -> None:
        """Cut the power of all servos and restore it at `t`."""
        for servo in self.servos:
            servo.reboot(t)

    def send(self, data: bytes, t: float, baud: int) -> list[Reply]:
        """Send the host's `data` and return the answers.

        The first byte is on the wire at `t` [s], or as soon as the wire is free.
        """
        t = max(t, self._last_byte_s)
        if t - self._last_byte_s > _Settings.forget_after_s:
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
        """Return all complete instructions in `stream`, and the number of bytes consumed."""

    @abstractmethod
    def _answers(self, instruction: Any, t: float, baud: int) -> list[Reply]:
        """Return the answers to an instruction received at `t`."""

    @abstractmethod
    def _read(self, servo: ServoT, address: int, size: int, t: float) -> tuple[int, bytes]:
        """Return error and data of a part of the control table at `t`."""

    @abstractmethod
    def _packet(self, servo: ServoT, id: int, error: Any, params: bytes) -> bytes:
        """Build a status packet of a servo that was addressed by this ID."""

    @abstractmethod
    def _will_answer(self, servo: ServoT, code: int) -> bool:
        """Return True if the servo's status return level allows an answer to this instruction."""

    def _listening(self, baud: int) -> list[ServoT]:
        return [servo for servo in self.servos if abs((its := servo.baud) - baud) <= _Settings.baud_tolerance * its]

    def _common_answer(
        self, servos: list[ServoT], t: float, act: Callable[[ServoT, float], tuple[Any, bytes]], code: int
    ) -> list[Reply]:
        """Return the common answer of all servos with one ID (usually one servo); empty if no servo answers."""
        if not servos:
            return []
        start = t + min(servo.return_delay_s for servo in servos)
        id = servos[0].id  # a servo that is given a new ID still answers with the old one
        done = [(servo, act(servo, start)) for servo in servos]
        packets = [self._packet(servo, id, *outcome) for servo, outcome in done if self._will_answer(servo, code)]
        return [Reply(id, start, mixed(packets))] if packets else []

    def _answers_in_turn(
        self, servos: list[ServoT], requested: list[tuple[int, int, int]], t: float, code: int
    ) -> list[Reply]:
        replies: list[Reply] = []
        for id, address, size in requested:
            addressed = [s for s in servos if s.id == id]
            reply = self._common_answer(addressed, t, lambda s, now, a=address, n=size: self._read(s, a, n, now), code)
            replies += reply
            begin, count = (reply[0].start, len(reply[0].data)) if reply else (t, size + self.overhead)
            t = begin + count * self._byte_s
        return replies

    def _write_each(self, servos: list[ServoT], address: int, size: int, entries: bytes, t: float) -> None:
        """Write the data of each entry of a SYNC_WRITE, an ID and `size` bytes, to the servos of that ID."""
        for k in range(0, len(entries) - size, size + 1):
            for servo in servos:
                if servo.id == entries[k]:
                    servo.write(address, entries[k + 1 : k + 1 + size], t)


def mixed(packets: list[bytes]) -> bytes:
    """Return the bytes heard when all packets are sent at the same time."""
    if len(packets) == 1:
        return packets[0]
    return bytes(reduce(and_, together) for together in zip(*packets, strict=False))
