"""Instruction packets put together, status packets taken apart.

Source: Feetech, "Communication protocol manual of the smart bus servos" (doc.feetech.cn).
"""

from __future__ import annotations

from collections.abc import Sequence

from bodyschema.drivers.servos.packets import HEADER, Status, take_summed

BROADCAST = 0xFE
PING, READ, WRITE, SYNC_READ = 1, 2, 3, 0x82


class FeetechPackets:
    """The protocol of all series; they differ in the byte order of registers only."""

    overhead, ping_size = 6, 0
    refusals, is_weak = 0xC0, True  # no servo sets these two bits
    # At any Response Status Level they answer READ.
    pinged_only = "answers PING but no READ: look at its cable and supply"

    def ping(self, id: int) -> bytes:
        """PING."""
        return _packet(id, PING)

    def read(self, id: int, address: int, size: int) -> bytes:
        """READ."""
        return _packet(id, READ, bytes((address, size)))

    def write(self, id: int, address: int, data: bytes) -> bytes:
        """WRITE."""
        return _packet(id, WRITE, bytes((address,)) + data)

    def sync_read(self, ids: Sequence[int], address: int, size: int) -> bytes:
        """SYNC_READ: all of `ids` answer, in this order."""
        return _packet(BROADCAST, SYNC_READ, bytes((address, size, *ids)))

    def take(self, received: bytes | bytearray, at: int) -> Status | None:
        """The status packet that begins at `at`; see `Packets.take`."""
        return take_summed(received, at)


def _packet(id: int, code: int, params: bytes = b"") -> bytes:
    body = bytes((id, len(params) + 2, code)) + params
    return HEADER + body + bytes((~sum(body) & 0xFF,))
