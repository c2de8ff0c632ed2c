"""Interface of a packet codec: build instructions, parse status packets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Garbled(Exception):
    """Raised for bytes that are not an intact status packet."""


@dataclass(frozen=True, slots=True)
class Status:
    """A servo's answer."""

    id: int  # the sender's ID as received
    error: int  # the error byte as received
    data: bytes  # without stuffing
    size: int  # on the wire [bytes]


class Packets(Protocol):
    """One version of a vendor's protocol.

    Attributes:
        overhead: size of a status packet without its data [bytes].
        ping_size: data bytes in the answer to PING.
        refusals: bits of the error byte with which a servo rejects the request; the others report its health.
        is_weak: True if the checksum lets one in 256 wrong answers through, and no servo clock reveals late ones.
        pinged_only: message for a servo that answers PING but no READ.
    """

    overhead: int
    ping_size: int
    refusals: int
    is_weak: bool
    pinged_only: str

    def ping(self, id: int) -> bytes: ...

    def read(self, id: int, address: int, size: int) -> bytes: ...

    def write(self, id: int, address: int, data: bytes) -> bytes: ...

    def take(self, received: bytes | bytearray, at: int) -> Status | None:
        """Return the status packet that begins at `at`; None if it is incomplete.

        Raises:
            Garbled: no status packet begins there.
        """


HEADER, LARGEST_ID = b"\xff\xff", 0xFD
BROADCAST = 0xFE


def summed(id: int, code: int, params: bytes = b"") -> bytes:
    """Build a packet of the older protocols; `code` is the instruction, or the error in a status packet."""
    body = bytes((id, len(params) + 2, code)) + params
    return HEADER + body + bytes((~sum(body) & 0xFF,))


def take_summed(received: bytes | bytearray, at: int) -> Status | None:
    """Implement `Packets.take` for the older protocols: two bytes 0xFF, ID, length, error, data, inverted sum."""
    head = bytes(received[at : at + 4])
    if not HEADER.startswith(head[:2]) or (len(head) > 2 and head[2] > LARGEST_ID):
        raise Garbled
    if len(head) < 4:
        return None
    if head[3] < 2:
        raise Garbled
    size = 4 + head[3]
    packet = bytes(received[at : at + size])
    if len(packet) < size:
        return None
    if sum(packet[2:]) & 0xFF != 0xFF:
        raise Garbled
    return Status(packet[2], packet[4], packet[5:-1], size)
