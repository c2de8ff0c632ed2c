"""Emulate the Feetech servos of a robot.toml."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from random import Random

from bodyschema.drivers.emulator.chain import ServoChain, mixed
from bodyschema.drivers.emulator.device import Angle, Faults, Reply, Sampling
from bodyschema.drivers.emulator.faults import ON_THE_WIRE, FaultKinds
from bodyschema.drivers.emulator.servo_arm import AT_THE_START, ServoArm
from bodyschema.drivers.feetech.config import FeetechConfig, ServoConfig
from bodyschema.drivers.feetech.emulator.servo import Servo
from bodyschema.drivers.feetech.models import BAUDS
from bodyschema.drivers.servos.packets import BROADCAST, HEADER, summed


def swapped(reply: Reply, rng: Random) -> Reply:
    """Replace the ID by another one, with a matching checksum."""
    data = bytearray(reply.data)
    data[2] = (reply.id + rng.choice((-1, 1))) % 253
    data[-1] = ~sum(data[2:-1]) & 0xFF
    return replace(reply, data=bytes(data))


class Code(IntEnum):
    """Instructions (Feetech, communication protocol manual)."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    RESET = 0x06
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


@dataclass(frozen=True, slots=True)
class Instruction:
    """One packet from the host."""

    id: int
    code: int
    params: bytes
    end: int  # offset in the stream just behind its last byte


def instructions_in(stream: bytearray) -> tuple[list[Instruction], int]:
    """Return all intact instruction packets in `stream`, and the number of bytes consumed."""
    found: list[Instruction] = []
    at = 0
    while True:
        begun = at
        at = stream.find(HEADER, at)
        if at < 0:
            return found, max(begun, len(stream) - int(stream.endswith(b"\xff")))
        if len(stream) < at + 4:
            return found, at
        id, length = stream[at + 2], stream[at + 3]
        if id == 0xFF or length < 2:
            at += 1
            continue
        end = at + 4 + length
        if len(stream) < end:
            return found, at
        if sum(stream[at + 2 : end]) & 0xFF == 0xFF:
            found.append(Instruction(id, stream[at + 4], bytes(stream[at + 5 : end - 1]), end))
            at = end
        else:
            at += 1


class Chain(ServoChain[Servo]):
    """Feetech servos on one half-duplex wire; see `ServoChain`. A damaged instruction is not answered."""

    overhead = 6

    def _instructions_in(self, stream: bytearray) -> tuple[list[Instruction], int]:
        return instructions_in(stream)

    def _packet(self, servo: Servo, id: int, error: int, params: bytes) -> bytes:
        del servo
        return summed(id, error, params)

    def _will_answer(self, servo: Servo, code: int) -> bool:
        return servo["status_return"] > 0 or code in (Code.PING, Code.READ, Code.SYNC_READ)

    def _answers(self, instruction: Instruction, t: float, baud: int) -> list[Reply]:
        hearing, params = self._listening(baud), instruction.params
        if instruction.code == Code.SYNC_READ:
            knowing = [servo for servo in hearing if servo.knows_sync_read]
            requested = [(id, params[0], params[1]) for id in params[2:]]
            return self._answers_in_turn(knowing, requested, t, Code.SYNC_READ)
        if instruction.code == Code.SYNC_WRITE:
            if len(params) >= 2:
                self._write_each(hearing, params[0], params[1], params[2:], t)
            return []
        is_for_all = instruction.id == BROADCAST
        addressed = [servo for servo in hearing if is_for_all or servo.id == instruction.id]
        addressed = [servo for servo in addressed if self._is_understood(servo, instruction)]
        if is_for_all and instruction.code != Code.PING:
            for servo in addressed:
                self._obey(servo, instruction, t)
            return []
        if is_for_all:
            return self._pinged(addressed, t)
        return self._common_answer(
            addressed, t, lambda servo, now: self._obey(servo, instruction, now), instruction.code
        )

    def _pinged(self, servos: list[Servo], t: float) -> list[Reply]:
        """Return the answers to a broadcast PING.

        Servos of the SCS series answer at once; of the others each ID has its time slot.
        """
        at_once = [servo for servo in servos if not servo.knows_sync_read]
        groups = [[servo for servo in servos if servo.knows_sync_read and servo.id == id] for id in range(BROADCAST)]
        # Shorter than the 3 ms per ID, besides the bytes, that scan_port of huggingface/lerobot waits, and longer than
        # the longest return delay.
        slot_s = self.overhead * self._byte_s + 1e-3
        replies = [
            Reply(group[0].id, t + id * slot_s + group[0].return_delay_s, mixed(self._pongs(group)))
            for id, group in enumerate(groups)
            if group
        ]
        if at_once:
            replies.append(Reply(at_once[0].id, t + at_once[0].return_delay_s, mixed(self._pongs(at_once))))
        return replies

    def _pongs(self, servos: list[Servo]) -> list[bytes]:
        return [summed(servo.id, servo["status"]) for servo in servos]

    def _is_understood(self, servo: Servo, instruction: Instruction) -> bool:
        params = instruction.params
        match instruction.code:
            case Code.PING | Code.ACTION | Code.RESET:
                return True
            case Code.READ:
                return len(params) == 2 and params[1] > 0 and sum(params) <= servo.model.layout.size
            case Code.WRITE | Code.REG_WRITE:
                return len(params) > 1
            case _:
                return False

    def _obey(self, servo: Servo, instruction: Instruction, t: float) -> tuple[int, bytes]:
        params = instruction.params
        match instruction.code:
            case Code.READ:
                return self._read(servo, params[0], params[1], t)
            case Code.WRITE:
                servo.write(params[0], params[1:], t)
            case Code.REG_WRITE:
                servo.register_write(params[0], params[1:])
            case Code.ACTION:
                servo.action(t)
            case Code.RESET:
                servo.factory_reset(t)
        return servo["status"], b""

    def _read(self, servo: Servo, address: int, size: int, t: float) -> tuple[int, bytes]:
        position = servo.model.layout["position"]
        if address <= position.address and position.end <= address + size:
            self.samplings[servo.id] = Sampling(t, servo.angle(t))
        return servo["status"], servo.read(address, size, t) or b""


# Bits of the status.
ERRORS = {"voltage": 0x01, "encoder": 0x02, "hot": 0x04, "current": 0x08, "overload": 0x20}
KINDS = FaultKinds({**ON_THE_WIRE, "swapped": swapped}, (*ERRORS, *AT_THE_START, "glitch"))
OTHER_BAUD = {500_000: 1_000_000}  # any other rate: 500000


class FeetechArm(ServoArm[Servo, FeetechConfig]):
    """Feetech servos as configured; see `ServoArm`."""

    kinds, errors = KINDS, ERRORS

    def _servo(self, entry: ServoConfig, angle: Angle) -> Servo:
        baud = self._config.buses[self._config.bus_of(entry)].baud
        model, delay_s = self._config.model_of(entry), self._return_delay_s
        return Servo(model, entry.id, angle, baud=baud, return_delay_s=delay_s)

    def _chain(self, servos: Sequence[Servo], faults: Faults) -> Chain:
        return Chain(servos, faults)

    def _change_rate(self, servo: Servo) -> None:
        servo["baud"] = BAUDS.index(OTHER_BAUD.get(servo.baud, 500_000))
