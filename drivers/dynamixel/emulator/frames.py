"""Parse instruction packets and build status packets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from bodyschema.drivers.dynamixel.crc16 import crc16
from bodyschema.drivers.servos.packets import BROADCAST, summed

HEADER1, HEADER2 = b"\xff\xff", b"\xff\xff\xfd\x00"
LONGEST = 1024
STATUS = 0x55
Protocol = Literal[1, 2]


class Code(IntEnum):
    """Instructions (ROBOTIS e-Manual, Protocols 1.0 and 2.0)."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class Error(IntEnum):
    """Error numbers in a status packet of Protocol 2.0."""

    NONE = 0
    RESULT = 1
    INSTRUCTION = 2
    CRC = 3
    RANGE = 4
    LENGTH = 5
    LIMIT = 6
    ACCESS = 7


ALERT = 0x80
ERRORS1 = {Error.INSTRUCTION: 0x40, Error.CRC: 0x10}  # in Protocol 1.0 all others are 0x08, out of range


@dataclass(frozen=True, slots=True)
class Instruction:
    """One packet from the host."""

    protocol: Protocol
    id: int
    code: int
    params: bytes  # without stuffing
    intact: bool  # the checksum is right
    end: int  # offset in the stream just behind its last byte


def instructions_in(stream: bytearray) -> tuple[list[Instruction], int]:
    """Return all complete instruction packets in `stream`, and the number of bytes consumed."""
    found: list[Instruction] = []
    at = 0
    while True:
        begun = at
        at = stream.find(HEADER1, at)
        if at < 0:
            keep = 1 if stream.endswith(b"\xff") else 0
            return found, max(begun, len(stream) - keep)
        size = _size(stream, at)
        if size is None or (size > 0 and at + size > len(stream)):
            return found, at
        if size == 0:
            at += 1
            continue
        instruction = _instruction(bytes(stream[at : at + size]), at + size)
        found.append(instruction)
        at = instruction.end if instruction.intact else at + 1


def _size(stream: bytearray, at: int) -> int | None:
    """Return the size of the packet that begins at `at` [bytes]: 0 if none does, None if more bytes are needed."""
    head = stream[at : at + 7]
    if len(head) < 4:
        return None
    if head[:4] == HEADER2:
        if len(head) < 7:
            return None
        length = head[5] | head[6] << 8
        return 7 + length if 3 <= length <= LONGEST else 0
    if head[2] == 0xFF or head[2] == 0xFD or head[3] < 2:
        return 0
    return 4 + head[3]


def _instruction(packet: bytes, end: int) -> Instruction:
    if packet[:4] == HEADER2:
        intact = crc16(packet[:-2]) == packet[-2] | packet[-1] << 8
        body = packet[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        return Instruction(2, packet[4], body[0], body[1:], intact, end)
    intact = sum(packet[2:]) & 0xFF == 0xFF
    return Instruction(1, packet[2], packet[4], packet[5:-1], intact, end)


def status_packet(protocol: int, id: int, error: int, params: bytes) -> bytes:
    """Build a servo's answer."""
    if protocol == 1:
        return summed(id, error, params)
    body = bytes((STATUS, error)) + params
    stuffed = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    packet = HEADER2 + bytes((id,)) + (len(stuffed) + 2).to_bytes(2, "little") + stuffed
    return packet + crc16(packet).to_bytes(2, "little")


def fast_header(sizes: Sequence[int]) -> bytes:
    """Build the start of the answer to FAST_SYNC_READ and FAST_BULK_READ; `sizes` are the data bytes per servo."""
    length = 1 + sum(size + 4 for size in sizes)
    return HEADER2 + bytes((BROADCAST,)) + length.to_bytes(2, "little") + bytes((STATUS,))


def fast_block(before: bytes, id: int, error: int, params: bytes) -> bytes:
    """Build one servo's part of it, unstuffed, with the checksum of everything on the wire so far."""
    block = bytes((error, id)) + params
    return block + crc16(before + block).to_bytes(2, "little")
