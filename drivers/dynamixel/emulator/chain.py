"""Emulated Dynamixel servos on one wire: bytes in, timed bytes out."""

from __future__ import annotations

from bodyschema.drivers.dynamixel.models import PING_SLOT_S
from bodyschema.drivers.emulator.chain import ServoChain, mixed
from bodyschema.drivers.emulator.device import Reply, Sampling, no_faults

from .frames import (
    ALERT,
    BROADCAST,
    ERRORS1,
    Code,
    Error,
    Instruction,
    fast_block,
    fast_header,
    instructions_in,
    status_packet,
)
from .servo import Servo

__all__ = ["Chain", "no_faults"]


class Chain(ServoChain[Servo]):
    """Dynamixel servos on one half-duplex wire, of Protocols 2.0 and 1.0; see `ServoChain`."""

    overhead = 11

    def _instructions_in(self, stream: bytearray) -> tuple[list[Instruction], int]:
        return instructions_in(stream)

    def _packet(self, servo: Servo, id: int, error: Error, params: bytes) -> bytes:
        return status_packet(servo.model.protocol, id, _error_byte(servo, error), params)

    def _will_answer(self, servo: Servo, code: int) -> bool:
        level = servo["status_return"]
        return code == Code.PING or level == 2 or (level == 1 and code == Code.READ)

    def _answers(self, instruction: Instruction, t: float, baud: int) -> list[Reply]:
        hearing = [s for s in self._listening(baud) if s.model.protocol == instruction.protocol]
        if not instruction.intact:
            addressed = [s for s in hearing if s.id == instruction.id]
            return self._common_answer(addressed, t, _complain, Code.READ)
        for servo in hearing:
            if _is_for(instruction, servo.id):
                servo.hear(t)
        many = {
            Code.SYNC_READ: self._sync_read,
            Code.FAST_SYNC_READ: self._fast_sync_read,
            Code.BULK_READ: self._bulk_read,
            Code.FAST_BULK_READ: self._fast_bulk_read,
            Code.SYNC_WRITE: self._sync_write,
            Code.BULK_WRITE: self._bulk_write,
        }.get(instruction.code)  # type: ignore[call-overload]
        if many is not None and not (instruction.protocol == 1 and instruction.code in _ONLY2):
            return many(hearing, instruction, t)
        if instruction.id == BROADCAST:
            return self._broadcast(hearing, instruction, t)
        addressed = [s for s in hearing if s.id == instruction.id]
        return self._common_answer(
            addressed, t, lambda servo, now: self._obey(servo, instruction, now), instruction.code
        )

    def _obey(self, servo: Servo, instruction: Instruction, t: float) -> tuple[Error, bytes]:
        params, wide = instruction.params, instruction.protocol
        match instruction.code:
            case Code.PING:
                answers = servo["model"].to_bytes(2, "little") + bytes((servo["firmware"],))
                return Error.NONE, answers if wide == 2 else b""
            case Code.READ if len(params) == 2 * wide:
                return self._read(servo, int.from_bytes(params[:wide], "little"), _number(params[wide:]), t)
            case Code.WRITE if len(params) > wide:
                return servo.write(_number(params[:wide]), params[wide:], t), b""
            case Code.REG_WRITE if len(params) > wide:
                return servo.register_write(_number(params[:wide]), params[wide:]), b""
            case Code.ACTION:
                return servo.action(t), b""
            case Code.FACTORY_RESET:
                return servo.factory_reset(params[0] if params else 0xFF, t), b""
            case Code.REBOOT if wide == 2:
                servo.reboot(t)
                return Error.NONE, b""
            case Code.CLEAR if wide == 2 and params == b"\x01DXL\x22":
                return servo.clear_turns(t), b""
            case _:
                return Error.INSTRUCTION, b""

    def _read(self, servo: Servo, address: int, size: int, t: float) -> tuple[Error, bytes]:
        position, places = servo.model.layout["position"], servo.places(address, size)
        if all(place in places for place in range(position.address, position.end)):
            self.samplings[servo.id] = Sampling(t, servo.angle(t))
        return servo.read(address, size, t)

    def _broadcast(self, servos: list[Servo], instruction: Instruction, t: float) -> list[Reply]:
        if instruction.code != Code.PING:
            for servo in servos:
                self._obey(servo, instruction, t)
            return []
        by_id = {servo.id: [s for s in servos if s.id == servo.id] for servo in servos}
        replies: list[Reply] = []
        for id in sorted(by_id):
            slot = t + id * PING_SLOT_S
            replies += self._common_answer(by_id[id], slot, lambda s, now: self._obey(s, instruction, now), Code.PING)
        return replies

    def _sync_read(self, servos: list[Servo], instruction: Instruction, t: float) -> list[Reply]:
        address, size = _number(instruction.params[:2]), _number(instruction.params[2:4])
        return self._answers_in_turn(servos, [(id, address, size) for id in instruction.params[4:]], t, Code.READ)

    def _bulk_read(self, servos: list[Servo], instruction: Instruction, t: float) -> list[Reply]:
        params = instruction.params
        if instruction.protocol == 1:  # a zero, then length, ID, address of each
            parts = [params[k : k + 3] for k in range(1, len(params) - 2, 3)]
            return self._answers_in_turn(servos, [(id, address, size) for size, id, address in parts], t, Code.READ)
        return self._answers_in_turn(servos, _bulk_parts(params), t, Code.READ)

    def _fast_bulk_read(self, servos: list[Servo], instruction: Instruction, t: float) -> list[Reply]:
        return self._fast_answer(servos, _bulk_parts(instruction.params), t)

    def _fast_sync_read(self, servos: list[Servo], instruction: Instruction, t: float) -> list[Reply]:
        address, size = _number(instruction.params[:2]), _number(instruction.params[2:4])
        return self._fast_answer(servos, [(id, address, size) for id in instruction.params[4:]], t)

    def _fast_answer(self, servos: list[Servo], parts: list[tuple[int, int, int]], t: float) -> list[Reply]:
        """Return the common answer of servos, given ID, address and size of each."""
        packet = fast_header([size for _, _, size in parts])
        start = now = t
        for place, (id, address, size) in enumerate(parts):
            addressed = [s for s in servos if s.id == id and s.fast and s["status_return"] > 0]
            if not addressed:  # a servo behind a missing one does not know when its turn comes
                return [Reply(parts[0][0], start, packet)] if place else []
            if place == 0:
                start = t + addressed[0].return_delay_s
            now = start + len(packet) * self._byte_s
            answers = [(servo, *self._read(servo, address, size, now)) for servo in addressed]
            packet += mixed([fast_block(packet, id, _error_byte(servo, error), data) for servo, error, data in answers])
        return [Reply(parts[0][0], start, packet)] if parts else []

    def _sync_write(self, servos: list[Servo], instruction: Instruction, t: float) -> list[Reply]:
        wide, params = instruction.protocol, instruction.params
        address, size = _number(params[:wide]), _number(params[wide : 2 * wide])
        self._write_each(servos, address, size, params[2 * wide :], t)
        return []

    def _bulk_write(self, servos: list[Servo], instruction: Instruction, t: float) -> list[Reply]:
        params = instruction.params
        k = 0
        while k + 5 <= len(params):
            id, address, size = params[k], _number(params[k + 1 : k + 3]), _number(params[k + 3 : k + 5])
            self._write_each(servos, address, size, bytes((id,)) + params[k + 5 : k + 5 + size], t)
            k += 5 + size
        return []


_LISTS = (Code.SYNC_READ, Code.FAST_SYNC_READ, Code.SYNC_WRITE)
_ONLY2 = (Code.SYNC_READ, Code.FAST_SYNC_READ, Code.FAST_BULK_READ, Code.BULK_WRITE)


def _bulk_parts(params: bytes) -> list[tuple[int, int, int]]:
    """Return ID, address and size of each servo addressed by a BULK_READ of Protocol 2.0."""
    parts = (params[k : k + 5] for k in range(0, len(params) - 4, 5))
    return [(part[0], _number(part[1:3]), _number(part[3:5])) for part in parts]


def _is_for(instruction: Instruction, id: int) -> bool:
    """Return True if the instruction addresses this servo: by its ID, by broadcast, or in a list."""
    if instruction.id != BROADCAST or instruction.code not in _LISTS:
        return instruction.id in (id, BROADCAST)
    wide, params = instruction.protocol, instruction.params
    if instruction.code in (Code.SYNC_READ, Code.FAST_SYNC_READ):
        return id in params[4:]
    return id in params[2 * wide :: 1 + _number(params[wide : 2 * wide])]


def _complain(servo: Servo, t: float) -> tuple[Error, bytes]:
    del servo, t
    return Error.CRC, b""


def _number(data: bytes) -> int:
    return int.from_bytes(data, "little")


def _error_byte(servo: Servo, error: Error) -> int:
    if servo.model.protocol == 1:
        return servo.hardware_error | (0 if error is Error.NONE else ERRORS1.get(error, 0x08))
    return error | (ALERT if servo.hardware_error else 0)
