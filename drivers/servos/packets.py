"""What a bus needs of a protocol: instructions put together, status packets taken apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Garbled(Exception):
    """These bytes are no intact status packet."""


@dataclass(frozen=True, slots=True)
class Status:
    """A servo's answer.

    Attributes:
        id: who says that it is from them.
        error: the error byte as it came.
        data: without stuffing.
        size: bytes on the wire.
    """

    id: int
    error: int
    data: bytes
    size: int


class Packets(Protocol):
    """One version of a make's protocol.

    Attributes:
        overhead: bytes of a status packet besides its data.
        ping_size: bytes of data in the answer to PING.
        refusals: bits of the error byte with which a servo refuses the question; the others tell of its health.
        is_weak: the checksum lets one in 256 wrong answers through, and no servo's clock tells of late ones.
        pinged_only: what is to be said of a servo that answers PING but no READ.
    """

    overhead: int
    ping_size: int
    refusals: int
    is_weak: bool
    pinged_only: str

    def ping(self, id: int) -> bytes:
        """PING."""
        ...

    def read(self, id: int, address: int, size: int) -> bytes:
        """READ."""
        ...

    def write(self, id: int, address: int, data: bytes) -> bytes:
        """WRITE."""
        ...

    def take(self, received: bytes | bytearray, at: int) -> Status | None:
        """The status packet that begins at `at`; None when it is not complete. Raises Garbled when there is none."""
        ...


HEADER, LARGEST_ID = b"\xff\xff", 0xFD


def take_summed(received: bytes | bytearray, at: int) -> Status | None:
    """As `Packets.take`, of the older protocols: two bytes 0xFF, ID, length, error, data, inverted sum."""
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
