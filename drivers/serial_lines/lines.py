"""Parse the lines of an encoder board strictly. docs/hardware.md defines them.

A line is ASCII, `content*CRC` and a line feed; CRC is that of the content, four upper-case hexadecimal digits. The
header is `H,1,boot,n,name1,ticks1,...,nameN,ticksN`, a reading is `seq,t_us,a1,...,aN`.
"""

from __future__ import annotations

import binascii
import re
from dataclasses import dataclass

VERSION = 1
INITIAL = 0xFFFF  # of CRC-16/CCITT-FALSE, whose polynomial is 0x1021: "123456789" gives 29B1
SEQUENCES = 2**16
STAMPS, STAMP_S = 2**32, 1e-6
LONGEST = 256  # bytes of a line with its line feed
ASK_HEADER = b"?\n"
LARGEST_TICKS = 2**31

_LINE = re.compile(rb"([!-)+-~]+)\*([0-9A-F]{4})\r?")
_HEADER = re.compile(r"H,(\d{1,3}),(\d{1,5}),(\d{1,2}),(.+)")
_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
_NUMBER, _SIGNED = re.compile(r"\d{1,10}"), re.compile(r"-?\d{1,10}")
NO_VALUE = "-"


class GarbledLine(Exception):
    """Raised for a line that is not intact."""


@dataclass(frozen=True, slots=True)
class Header:
    boot: int  # a new random number at each start
    encoders: dict[str, int]  # by name, ticks after which the reading repeats


@dataclass(frozen=True, slots=True)
class Reading:
    """A measurement of a board."""

    seq: int  # one more than before, modulo 2^16
    t_us: int  # the board's time in the middle of the measurement [µs], modulo 2^32
    ticks: tuple[int | None, ...]  # raw, in the order of the header; None where the sensor fails


def crc_ccitt(data: bytes) -> int:
    """Return the checksum of a line's content."""
    return binascii.crc_hqx(data, INITIAL)


def with_checksum(content: str) -> bytes:
    """Build the line of a content."""
    data = content.encode("ascii")
    return data + f"*{crc_ccitt(data):04X}\n".encode("ascii")


def parse(line: bytes) -> Header | Reading:
    """Parse a line without its line feed; raise GarbledLine if it is not intact."""
    found = _LINE.fullmatch(line)
    if found is None or crc_ccitt(found[1]) != int(found[2], 16):
        raise GarbledLine
    content = found[1].decode("ascii")
    return _header(content) if content.startswith("H") else _reading(content)


def _header(content: str) -> Header:
    found = _HEADER.fullmatch(content)
    if found is None or int(found[1]) != VERSION or int(found[2]) >= SEQUENCES:
        raise GarbledLine
    words = found[4].split(",")
    names, ticks = words[::2], words[1::2]
    encoders = {
        name: int(number)
        for name, number in zip(names, ticks, strict=False)
        if _NAME.fullmatch(name) and _NUMBER.fullmatch(number)
    }
    if len(words) != 2 * int(found[3]) or len(encoders) != int(found[3]):
        raise GarbledLine
    if not all(1 < count <= LARGEST_TICKS for count in encoders.values()):
        raise GarbledLine
    return Header(int(found[2]), encoders)


def _reading(content: str) -> Reading:
    words = content.split(",")
    if len(words) < 3:
        raise GarbledLine
    seq, t_us, *ticks = words
    if not _NUMBER.fullmatch(seq) or not _NUMBER.fullmatch(t_us):
        raise GarbledLine
    if int(seq) >= SEQUENCES or int(t_us) >= STAMPS:
        raise GarbledLine
    if not all(word == NO_VALUE or _SIGNED.fullmatch(word) for word in ticks):
        raise GarbledLine
    return Reading(int(seq), int(t_us), tuple(None if word == NO_VALUE else int(word) for word in ticks))
