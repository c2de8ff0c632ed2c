"""Parse instruction packets and build status packets."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

HEADER = b"\xff\xff"
BROADCAST = 0xFE


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
    """One packet from the host.

    Attributes:
        end: offset in the stream just behind its last byte.
    """

    id: int
    code: int
    params: bytes
    end: int


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


def status_packet(id: int, error: int, params: bytes) -> bytes:
    """Build a servo's answer."""
    body = bytes((id, len(params) + 2, error)) + params
    return HEADER + body + bytes((~sum(body) & 0xFF,))
