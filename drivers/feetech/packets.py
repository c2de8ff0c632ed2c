"""Build instruction packets and parse status packets.

Source: Feetech, "Communication protocol manual of the smart bus servos" (doc.feetech.cn).
"""

from __future__ import annotations

from collections.abc import Sequence

from bodyschema.drivers.servos.packets import HEADER, Status, take_summed

BROADCAST = 0xFE
PING, READ, WRITE, SYNC_READ = 1, 2, 3, 0x82


class FeetechPackets:
    """The protocol of all series, which differ only in the byte order of registers."""

    overhead, ping_size = 6, 0
    refusals, is_weak = 0xC0, True  # no servo sets these two bits
    # They answer READ at any Response Status Level.
    pinged_only = "answers PING but no READ: look at its cable and supply"

    def ping(self, id: int) -> bytes:
        """Build PING."""
        return _packet(id, PING)

    def read(self, id: int, address: int, size: int) -> bytes:
        """Build READ."""
        return _packet(id, READ, bytes((address, size)))

    def write(self, id: int, address: int, data: bytes) -> bytes:
        """Build WRITE."""
        return _packet(id, WRITE, bytes((address,)) + data)

    def sync_read(self, ids: Sequence[int], address: int, size: int) -> bytes:
        """Build SYNC_READ: all of `ids` answer, in this order."""
        return _packet(BROADCAST, SYNC_READ, bytes((address, size, *ids)))

    def take(self, received: bytes | bytearray, at: int) -> Status | None:
        """Return the status packet that begins at `at`; see `Packets.take`."""
        return take_summed(received, at)


def _packet(id: int, code: int, params: bytes = b"") -> bytes:
    body = bytes((id, len(params) + 2, code)) + params
    return HEADER + body + bytes((~sum(body) & 0xFF,))
