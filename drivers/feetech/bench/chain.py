"""Emulated Feetech servos on one wire: bytes in, timed bytes out."""

from __future__ import annotations

from bodyschema.drivers.bench.chain import ServoChain, mixed
from bodyschema.drivers.bench.device import Reply, Sampling

from .frames import BROADCAST, Code, Instruction, instructions_in, status_packet
from .servo import Servo

# Shorter than the 3 ms per ID, besides the bytes, that scan_port of huggingface/lerobot waits, and longer than the
# longest return delay.
PING_GAP_S = 1e-3


class Chain(ServoChain[Servo]):
    """Feetech servos on one half-duplex wire; see `ServoChain`. A damaged instruction is not answered."""

    overhead = 6

    def _instructions_in(self, stream: bytearray) -> tuple[list[Instruction], int]:
        return instructions_in(stream)

    def _packet(self, servo: Servo, id: int, error: int, params: bytes) -> bytes:
        del servo
        return status_packet(id, error, params)

    def _will_answer(self, servo: Servo, code: int) -> bool:
        return servo["status_return"] > 0 or code in (Code.PING, Code.READ, Code.SYNC_READ)

    def _answers(self, instruction: Instruction, t: float, baud: int) -> list[Reply]:
        hearing, params = self._listening(baud), instruction.params
        if instruction.code == Code.SYNC_READ:
            knowing = [servo for servo in hearing if servo.knows_sync_read]
            asked = [(id, params[0], params[1]) for id in params[2:]]
            return self._in_turn(knowing, asked, t, Code.SYNC_READ)
        if instruction.code == Code.SYNC_WRITE:
            self._sync_write(hearing, params, t)
            return []
        is_for_all = instruction.id == BROADCAST
        there = [servo for servo in hearing if is_for_all or servo.id == instruction.id]
        there = [servo for servo in there if self._is_understood(servo, instruction)]
        if is_for_all and instruction.code != Code.PING:
            for servo in there:
                self._obey(servo, instruction, t)
            return []
        if is_for_all:
            return self._pinged(there, t)
        return self._together(there, t, lambda servo, now: self._obey(servo, instruction, now), instruction.code)

    def _pinged(self, servos: list[Servo], t: float) -> list[Reply]:
        """Return the answers to a broadcast PING.

        Servos of the SCS series answer at once; of the others each ID has its time slot.
        """
        at_once = [servo for servo in servos if not servo.knows_sync_read]
        groups = [[servo for servo in servos if servo.knows_sync_read and servo.id == id] for id in range(BROADCAST)]
        slot_s = self.overhead * self._byte_s + PING_GAP_S
        replies = [
            Reply(group[0].id, t + id * slot_s + group[0].return_delay_s, mixed(self._pongs(group)))
            for id, group in enumerate(groups)
            if group
        ]
        if at_once:
            replies.append(Reply(at_once[0].id, t + at_once[0].return_delay_s, mixed(self._pongs(at_once))))
        return replies

    def _pongs(self, servos: list[Servo]) -> list[bytes]:
        return [status_packet(servo.id, servo["status"], b"") for servo in servos]

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

    def _sync_write(self, servos: list[Servo], params: bytes, t: float) -> None:
        if len(params) < 2:
            return
        address, size = params[0], params[1]
        for k in range(2, len(params) - size, size + 1):
            for servo in servos:
                if servo.id == params[k]:
                    servo.write(address, params[k + 1 : k + 1 + size], t)
