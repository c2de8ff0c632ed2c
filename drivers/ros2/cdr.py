"""Common Data Representation, the encoding of ROS 2 messages (OMG DDSI-RTPS 2.5, 10.2; XCDR version 1)."""

from __future__ import annotations

import struct

REPRESENTATIONS = {b"\x00\x00": ">", b"\x00\x01": "<"}  # CDR_BE, CDR_LE
UINT32 = {order: struct.Struct(f"{order}I") for order in "<>"}
ENCAPSULATION = 4  # bytes; alignment is relative to the end of this header
LARGEST_MESSAGE = 1 << 18


class Malformed(Exception):
    """Raised for bytes that are not the expected message."""


class CdrReader:
    """Reader of one message, front to back. It checks every length against the bytes that are left."""

    def __init__(self, data: bytes) -> None:
        """Start behind the encapsulation header.

        Raises:
            Malformed: the header is invalid, the representation unsupported, or the message absurdly long.
        """
        if len(data) > LARGEST_MESSAGE:
            raise Malformed(f"{len(data)} bytes are more than a message of joints has")
        if len(data) < ENCAPSULATION:
            raise Malformed(f"{len(data)} bytes are no message")
        # The two bytes after the representation are options, which a receiver ignores.
        order = REPRESENTATIONS.get(data[:2])
        if order is None:
            raise Malformed(f"the representation {data[:2].hex()} is neither CDR_LE nor CDR_BE")
        self._data, self._order, self._at = data, order, ENCAPSULATION
        self._uint32 = UINT32[order].unpack_from

    def int32(self) -> int:
        """Read a signed 4-byte integer."""
        return int(self._numbers("i", 4, 1)[0])

    def uint32(self) -> int:
        """Read an unsigned 4-byte integer."""
        begin = (self._at + 3) & ~3  # the encapsulation header has 4 bytes too, so alignment is unaffected
        if begin + 4 > len(self._data):
            raise Malformed("the message ends too early")
        self._at = begin + 4
        return self._uint32(self._data, begin)[0]

    def count(self, smallest: int) -> int:
        """Read the length of a sequence whose elements have at least `smallest` bytes."""
        count = self.uint32()
        if count * smallest > len(self._data) - self._at:
            raise Malformed(f"{count} elements are announced, {len(self._data) - self._at} bytes are left")
        return count

    def string(self) -> str:
        """Read a string. Its length includes a terminating zero byte, which an empty string may lack."""
        size = self.count(1)
        if size == 0:
            return ""
        raw = self._data[self._at : self._at + size]
        if raw.find(b"\0") != size - 1:
            raise Malformed("a text does not end where it should")
        self._at += size
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise Malformed("a text is not UTF-8") from error

    def strings(self) -> tuple[str, ...]:
        """Read a sequence of strings."""
        return tuple([self.string() for _ in range(self.count(4))])

    def float64s(self) -> tuple[float, ...]:
        """Read a sequence of 8-byte floats."""
        count = self.count(8)
        return self._numbers("d", 8, count) if count else ()

    def float64_array(self, count: int) -> tuple[float, ...]:
        """Read an array of 8-byte floats of fixed length."""
        return self._numbers("d", 8, count)

    def end(self) -> None:
        """Raise Malformed if any bytes are left."""
        if self._at != len(self._data):
            raise Malformed(f"{len(self._data) - self._at} bytes after the end of the message")

    def _numbers(self, kind: str, size: int, count: int) -> tuple[float, ...]:
        begin = ENCAPSULATION + _aligned(self._at - ENCAPSULATION, size)
        if begin + size * count > len(self._data):
            raise Malformed("the message ends too early")
        self._at = begin + size * count
        return struct.unpack_from(f"{self._order}{count}{kind}", self._data, begin)


class CdrWriter:
    """Writer of one message, with zero padding."""

    def __init__(self, *, big_endian: bool = False) -> None:
        self._order = ">" if big_endian else "<"
        self._data = bytearray(b"\x00\x00\x00\x00" if big_endian else b"\x00\x01\x00\x00")

    def int32(self, value: int) -> None:
        """Write a signed 4-byte integer."""
        self._numbers("i", 4, (value,))

    def uint32(self, value: int) -> None:
        """Write an unsigned 4-byte integer."""
        self._numbers("I", 4, (value,))

    def string(self, text: str) -> None:
        """Write a string with its terminating zero byte."""
        raw = text.encode() + b"\0"
        self.uint32(len(raw))
        self._data += raw

    def strings(self, texts: tuple[str, ...]) -> None:
        self.uint32(len(texts))
        for text in texts:
            self.string(text)

    def float64s(self, values: tuple[float, ...]) -> None:
        """Write a sequence of 8-byte floats."""
        self.uint32(len(values))
        if values:
            self.float64_array(values)

    def float64_array(self, values: tuple[float, ...]) -> None:
        """Write an array of 8-byte floats of fixed length."""
        self._numbers("d", 8, values)

    def to_bytes(self) -> bytes:
        return bytes(self._data)

    def _numbers(self, kind: str, size: int, values: tuple[float, ...]) -> None:
        at = len(self._data) - ENCAPSULATION
        self._data += bytes(_aligned(at, size) - at)
        self._data += struct.pack(f"{self._order}{len(values)}{kind}", *values)


def _aligned(at: int, size: int) -> int:
    return -(-at // size) * size
