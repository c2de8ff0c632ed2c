"""The checksum of Protocol 2.0."""

from __future__ import annotations

POLYNOMIAL = 0x8005  # ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0", CRC calculation: not reflected, begins with 0


def _remainder(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1) ^ POLYNOMIAL if crc & 0x8000 else crc << 1
    return crc & 0xFFFF


_TABLE = tuple(_remainder(byte) for byte in range(256))


def crc16(data: bytes | bytearray | memoryview, crc: int = 0) -> int:
    """The checksum of `data`, which follows bytes whose checksum is `crc`."""
    table = _TABLE
    for byte in data:
        crc = ((crc << 8) & 0xFF00) ^ table[(crc >> 8) ^ byte]
    return crc
