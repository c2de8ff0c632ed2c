"""Build instruction packets with dynamixel-sdk, and parse status packets strictly.

The SDK's own reception is not used: it takes a late answer for the answer to the next request, drops error bytes and
partial answers, and reads past garbage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, Literal

import dynamixel_sdk as sdk

from bodyschema.drivers.servos.packets import BROADCAST, Garbled, Packets, Status, take_summed

from .crc16 import crc16

HEADER2 = b"\xff\xff\xfd\x00"
STATUS = 0x55
ALERT = 0x80
LOOKS_LIKE_HEADER, STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"
Version = Literal[1, 2]
PING, REBOOT = 1, 8


class _Caught:
    """Port that captures the packets of the SDK instead of sending them."""

    is_using = False
    packet = b""

    def clearPort(self) -> None: ...

    def setPacketTimeout(self, length: int) -> None: ...

    def writePort(self, packet: list[int]) -> int:
        self.packet = bytes(packet)
        return len(packet)


def _built(send: Callable[[_Caught], object]) -> bytes:
    port = _Caught()
    send(port)
    return port.packet


class Packets2:
    """Protocol 2.0."""

    overhead, ping_size = 11, 3
    refusals, is_weak = 0x7F, False  # e-Manual, status packets
    pinged_only = (  # the register is in the RAM area, which holds 2 after power-up
        "answers PING but no READ: its Status Return Level (68; P series 516) is 0 until its supply is switched off "
        "and on; else the cable is bad"
    )
    _sdk: Any = sdk.PacketHandler(2.0)

    def ping(self, id: int) -> bytes:
        return _built(lambda port: self._sdk.txPacket(port, [0, 0, 0, 0, id, 3, 0, PING, 0, 0]))

    def reboot(self, id: int) -> bytes:
        """Build REBOOT."""
        return _built(lambda port: self._sdk.txPacket(port, [0, 0, 0, 0, id, 3, 0, REBOOT, 0, 0]))

    def read(self, id: int, address: int, size: int) -> bytes:
        return _built(lambda port: self._sdk.readTx(port, id, address, size))

    def write(self, id: int, address: int, data: bytes) -> bytes:
        packet = _built(lambda port: self._sdk.writeTxOnly(port, id, address, len(data), list(data)))
        return _stuffed(packet) if len(packet) == len(data) + 12 else packet

    def sync_read(self, ids: Sequence[int], address: int, size: int, *, fast: bool) -> bytes:
        """Build SYNC_READ or FAST_SYNC_READ."""
        return _sync_read(tuple(ids), address, size, fast)

    def sync_write(self, address: int, size: int, data: Mapping[int, bytes]) -> bytes:
        """Build SYNC_WRITE of `size` bytes to each ID. It is not acknowledged."""
        params = [byte for id, bytes_ in data.items() for byte in (id, *bytes_)]
        packet = _built(lambda port: self._sdk.syncWriteTxOnly(port, address, size, params, len(params)))
        return _stuffed(packet) if len(packet) == len(params) + 14 else packet

    def take(self, received: bytes | bytearray, at: int) -> Status | None:
        packet = self._complete(received, at)
        if packet is None:
            return None
        body = packet[7:-2].replace(STUFFED, LOOKS_LIKE_HEADER)
        if len(body) < 2:
            raise Garbled
        return Status(packet[4], body[1], body[2:], len(packet))

    def take_fast(self, received: bytes | bytearray, at: int, count: int, size: int) -> tuple[Status, ...] | None:
        """Return the parts of the common answer of `count` servos, `size` data bytes each, unstuffed; see `take`."""
        packet = self._complete(received, at)
        if packet is None:
            return None
        block = size + 4
        if packet[4] != BROADCAST or len(packet) != 8 + count * block:
            raise Garbled
        parts = [packet[8 + k * block : 8 + (k + 1) * block] for k in range(count)]
        # A servo continues the checksum of what it heard: after a collision the last one still fits.
        crc = crc16(packet[:8])
        for part in parts:
            crc = crc16(part[:-2], crc)
            if crc != part[-2] | part[-1] << 8:
                raise Garbled
            crc = crc16(part[-2:], crc)
        return tuple(Status(part[1], part[0], part[2:-2], block) for part in parts)

    def _complete(self, received: bytes | bytearray, at: int) -> bytes | None:
        head = bytes(received[at : at + 8])
        if not HEADER2.startswith(head[:4]) or (len(head) > 7 and head[7] != STATUS):
            raise Garbled
        if len(head) < 8:
            return None
        size = 7 + (head[5] | head[6] << 8)
        if not 11 <= size <= 1024:
            raise Garbled
        packet = bytes(received[at : at + size])
        if len(packet) < size:
            return None
        if crc16(packet[:-2]) != packet[-2] | packet[-1] << 8:
            raise Garbled
        return packet


class Packets1:
    """Protocol 1.0."""

    overhead, ping_size = 6, 0
    refusals, is_weak = 0x58, True
    pinged_only = (
        "answers PING but no READ: its Status Return Level (16) may be 0, which only DYNAMIXEL Wizard sets to 2 while "
        "it cannot be read; else the cable is bad"
    )
    _sdk: Any = sdk.PacketHandler(1.0)

    def ping(self, id: int) -> bytes:
        return _built(lambda port: self._sdk.txPacket(port, [0, 0, id, 2, PING, 0]))

    def read(self, id: int, address: int, size: int) -> bytes:
        return _built(lambda port: self._sdk.readTx(port, id, address, size))

    def write(self, id: int, address: int, data: bytes) -> bytes:
        return _built(lambda port: self._sdk.writeTxOnly(port, id, address, len(data), list(data)))

    def take(self, received: bytes | bytearray, at: int) -> Status | None:
        return take_summed(received, at)


PACKETS2, PACKETS1 = Packets2(), Packets1()


@cache
def _sync_read(ids: tuple[int, ...], address: int, size: int, fast: bool) -> bytes:
    """Build the packet once: every reading sends the same."""
    return _built(lambda port: PACKETS2._sdk.syncReadTx(port, address, size, list(ids), len(ids), fast))


def packets_of(protocol: int) -> Packets:
    return PACKETS2 if protocol == 2 else PACKETS1


def _stuffed(packet: bytes) -> bytes:
    """Add the byte stuffing that dynamixel-sdk 4.1 computes but does not send."""
    body = packet[7:-2].replace(LOOKS_LIKE_HEADER, STUFFED)
    packet = packet[:5] + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")
