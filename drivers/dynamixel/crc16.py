"""The checksum of Protocol 2.0."""

from __future__ import annotations

from functools import cache
from struct import unpack_from

POLYNOMIAL = 0x8005  # ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0", CRC calculation: not reflected, begins with 0


def _remainder(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1) ^ POLYNOMIAL if crc & 0x8000 else crc << 1
    return crc & 0xFFFF


_TABLE = tuple(_remainder(byte) for byte in range(256))


@cache
def _table_of_words() -> tuple[int, ...]:  # half as many steps
    return tuple((rest << 8 & 0xFF00) ^ _TABLE[rest >> 8 ^ low] for rest in _TABLE for low in range(256))


def crc16(data: bytes | bytearray | memoryview, crc: int = 0) -> int:
    """Return the checksum of `data`, continued from `crc`, the checksum of the bytes before it."""
    table, words = _table_of_words(), len(data) // 2
    for word in unpack_from(f">{words}H", data):
        crc = table[crc ^ word]
    return crc if len(data) == 2 * words else (crc << 8 & 0xFF00) ^ _TABLE[crc >> 8 ^ data[-1]]
