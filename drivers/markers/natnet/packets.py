"""The packets of NatNet 3.0 to 4.x: little-endian, a header (message, size) and the message's fields without padding.

The layout follows the bitstream that OptiTrack publishes with its SDK's depacketization samples.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from bodyschema.drivers.markers.report import Fault, Unusable

HEADER = struct.Struct("<HH")
SERVER = struct.Struct("<256s4B4B")
SERVER_CLOCK = struct.Struct("<QH?4B")
BODY = struct.Struct("<i3f4ffh")  # ID, position, quaternion (x, y, z, w), mean marker error, parameters
STAMPS = struct.Struct("<IIdQQQ")  # time code, its sub-frame, software time, mid-exposure, received, transmitted
TRACKED = 1
SIZED_SINCE = (4, 1)  # each section begins with its size in bytes, and assets were added
OLDEST, NEWEST = 3, 4
MAX_ITEMS = 100_000  # elements of a section
VECTOR_BYTES, LABELLED_BYTES = 12, 26

Version = tuple[int, int]
_Skip = Callable[["_Reader"], None]


class Message(IntEnum):
    CONNECT = 0
    SERVER_INFO = 1
    REQUEST_MODEL = 4
    MODEL = 5
    FRAME = 7
    KEEP_ALIVE = 10


@dataclass(frozen=True, slots=True)
class ServerInfo:
    """The server's answer to CONNECT."""

    application: str  # name of the program
    program: Version
    version: Version  # of NatNet, in which it streams
    ticks_per_s: int  # rate of the clock of its stamps
    data_port: int  # where it sends the frames to
    group: str  # address of the multicast group; empty if it sends to each client alone


@dataclass(frozen=True, slots=True)
class RigidBody:
    """A rigid body in a frame."""

    id: int  # its streaming ID
    x: tuple[float, float, float]  # position of its pivot [m]
    turn: tuple[float, float, float, float]  # quaternion (x, y, z, w)
    error: float  # mean distance of its markers from their places on the body [m]
    is_tracked: bool  # True if the pose was measured in this frame


@dataclass(frozen=True, slots=True)
class Frame:
    """The used part of a frame of motion capture data."""

    number: int  # of the frame
    bodies: tuple[RigidBody, ...]
    # exposed, sent: ticks of the server's clock at the middle of the exposure and when the frame was sent
    exposed: int
    sent: int
    time_s: float  # the program's own time, which a recording played back has, too [s]


def packet(message: Message, contents: bytes = b"") -> bytes:
    return HEADER.pack(message, len(contents)) + contents


def connect() -> bytes:
    """Return the packet that asks a server for its version and starts its frames."""
    return packet(Message.CONNECT, b"Ping\0")


def opened(data: bytes) -> tuple[int, bytes]:
    """Return the message and the contents of a packet; raise Unusable if its size differs from the announced one."""
    if len(data) < HEADER.size:
        raise Unusable(Fault.MALFORMED, f"{len(data)} bytes are no NatNet packet")
    message, size = HEADER.unpack_from(data)
    if size > len(data) - HEADER.size:
        raise Unusable(Fault.MALFORMED, f"{size} bytes are announced, {len(data) - HEADER.size} came")
    return message, data[HEADER.size : HEADER.size + size]


def server_info(contents: bytes) -> ServerInfo:
    """Read the answer to CONNECT; raise Unusable if it is too short."""
    if len(contents) < SERVER.size + SERVER_CLOCK.size:
        raise Unusable(Fault.MALFORMED, f"{len(contents)} bytes are no answer of a NatNet 3 or 4 server")
    name, major, minor, _, _, net_major, net_minor, _, _ = SERVER.unpack_from(contents)
    ticks, port, is_multicast, *group = SERVER_CLOCK.unpack_from(contents, SERVER.size)
    application = name.partition(b"\0")[0].decode("utf-8", "replace")
    address = ".".join(map(str, group)) if is_multicast else ""
    return ServerInfo(application, (major, minor), (net_major, net_minor), ticks, port, address)


def frame(contents: bytes, version: Version) -> Frame:
    """Read a frame; raise Unusable if its sections exceed its bytes."""
    reader = _Reader(contents)
    is_sized = version >= SIZED_SINCE
    number = reader.int32()
    reader.section(is_sized, _marker_set)
    reader.section(is_sized, lambda reader: reader.skip(VECTOR_BYTES))
    bodies = tuple(reader.bodies(is_sized))
    reader.section(is_sized, _skeleton)
    if is_sized:  # assets
        reader.section(is_sized, lambda reader: reader.skip(VECTOR_BYTES))
    reader.section(is_sized, lambda reader: reader.skip(LABELLED_BYTES))
    for _ in range(2):  # force plates and other devices
        reader.section(is_sized, _device)
    _, _, time_s, exposed, _, sent = reader.take(STAMPS)
    return Frame(number, bodies, exposed, sent, time_s)


def body_names(contents: bytes, version: Version) -> dict[int, str]:
    """Return the names of rigid bodies by streaming ID, from a description of the models."""
    reader, names = _Reader(contents), dict[int, str]()
    is_sized = version >= SIZED_SINCE
    for _ in range(reader.count()):
        kind = reader.int32()
        end = None if not is_sized else reader.int32() + reader.at
        if kind == 1:
            name = reader.string()
            names[reader.int32()] = name
        if end is not None:
            reader.go_to(end)
        elif not _skip_model(reader, kind, version):
            break  # rigid bodies come before the parts to which NatNet 3 gives no size
    return names


def _skip_model(reader: _Reader, kind: int, version: Version) -> bool:
    """Skip the rest of a description without a size; return False if its layout is not known."""
    if kind == 0:
        reader.string()
        for _ in range(reader.count()):
            reader.string()
    elif kind == 1:
        _rest_of_body(reader, version)
    elif kind == 2:
        reader.string()
        reader.int32()
        for _ in range(reader.count()):
            reader.string()
            reader.int32()
            _rest_of_body(reader, version)
    else:
        return False
    return True


def _rest_of_body(reader: _Reader, version: Version) -> None:
    reader.skip(4 + VECTOR_BYTES)  # parent, offset
    markers = reader.count()
    reader.skip(markers * (VECTOR_BYTES + 4))  # places, labels
    for _ in range(markers if version >= (4, 0) else 0):
        reader.string()


class _Reader:
    """Front-to-back reader of a packet's contents; checks each step against the remaining bytes."""

    def __init__(self, data: bytes) -> None:
        self._data, self.at = data, 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Read the fields of `layout`."""
        begin = self.at
        self.skip(layout.size)
        return layout.unpack_from(self._data, begin)

    def int32(self) -> int:
        """Read a signed integer."""
        return int.from_bytes(self.bytes(4), "little", signed=True)

    def count(self) -> int:
        """Read the number of elements of a section."""
        count = self.int32()
        if not 0 <= count <= MAX_ITEMS:
            raise Unusable(Fault.MALFORMED, f"{count} elements in a section")
        return count

    def string(self) -> str:
        """Read a text that ends with a zero byte."""
        end = self._data.find(b"\0", self.at)
        if end < 0:
            raise Unusable(Fault.MALFORMED, "a name without an end")
        text = self._data[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return text

    def bytes(self, size: int) -> bytes:
        begin = self.at
        self.skip(size)
        return self._data[begin : self.at]

    def skip(self, size: int) -> None:
        self.go_to(self.at + size)

    def go_to(self, at: int) -> None:
        """Continue at the byte `at`."""
        if not self.at <= at <= len(self._data):
            raise Unusable(Fault.MALFORMED, "the packet ends too early")
        self.at = at

    def section(self, is_sized: bool, skip: _Skip) -> None:
        count = self.count()
        if is_sized:
            self.skip(self.int32())
            return
        for _ in range(count):
            skip(self)

    def bodies(self, is_sized: bool) -> Iterator[RigidBody]:
        """Read the section of rigid bodies."""
        count = self.count()
        end = self.at + 4 + self.int32() if is_sized else None
        for _ in range(count):
            found, x, y, z, qx, qy, qz, qw, error, parameters = self.take(BODY)
            yield RigidBody(found, (x, y, z), (qx, qy, qz, qw), error, bool(parameters & TRACKED))
        if end is not None:
            self.go_to(end)


def _marker_set(reader: _Reader) -> None:
    reader.string()
    reader.skip(VECTOR_BYTES * reader.count())


def _skeleton(reader: _Reader) -> None:
    reader.skip(4)
    reader.skip(BODY.size * reader.count())


def _device(reader: _Reader) -> None:
    reader.skip(4)
    for _ in range(reader.count()):
        reader.skip(4 * reader.count())
