"""Receive datagrams, each with the kernel's time of its arrival."""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Sequence

from bodyschema.interfaces.errors import SourceLost
from bodyschema.interfaces.protocols import Clock

from .config import UdpTable
from .report import Packet

SO_TIMESTAMPNS = 35  # Linux: a struct timespec of CLOCK_REALTIME beside each datagram
STAMP = struct.Struct("@ll")


class _Settings:
    largest_bytes: int = 65535  # of a UDP datagram
    buffer_bytes: int = 1 << 20  # seconds of a mocap stream, while the reader waits for the encoders
    retry_s: float = 2.0
    longest_wait_s: float = 60.0  # in the kernel's buffer; more shows that the wall clock was set meanwhile


def listening(host: str, port: int, *, shared: bool = False) -> socket.socket:
    """Return a socket on host and port, whose datagrams are timestamped by the kernel.

    Args:
        shared: True if other programs may listen there too, as is usual for multicast.

    Raises:
        OSError: the address cannot be used.
    """
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if shared:
            found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _Settings.buffer_bytes)
        found.bind((host, port))
        found.setblocking(False)
    except BaseException:
        found.close()
        raise
    return found


def received(found: socket.socket, clock: Clock) -> tuple[bytes, tuple[str, int], float] | None:
    """Return the next datagram, its sender, and its time of arrival [s]; None if none has arrived."""
    try:
        payload, ancillary, _, sender = found.recvmsg(_Settings.largest_bytes, socket.CMSG_SPACE(STAMP.size))
    except (BlockingIOError, ConnectionRefusedError):
        return None
    waited_s = 0.0
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(data) == STAMP.size:
            seconds, nanoseconds = STAMP.unpack(data)
            waited_s = 1e-9 * (time.time_ns() - seconds * 1_000_000_000 - nanoseconds)
    return payload, sender, clock.now() - (waited_s if 0.0 < waited_s < _Settings.longest_wait_s else 0.0)


def await_any(sockets: Sequence[socket.socket], until: float, clock: Clock) -> bool:
    """Return True as soon as a socket has a datagram; False if none has one by `until` [s]."""
    return bool(select.select(sockets, [], [], max(0.0, until - clock.now()))[0])


class UdpReceiver:
    """A UDP port that a program sends to."""

    def __init__(self, table: UdpTable, clock: Clock) -> None:
        self._table, self._clock = table, clock
        self._socket: socket.socket | None = None
        self._strangers = 0

    def open(self) -> None:
        """Listen; raise SourceLost if another program already does, or the address is not this machine's."""
        try:
            self._socket = listening(self._table.host, self._table.port)
        except OSError as error:
            raise SourceLost(
                f"UDP port {self._table.port} of {self._table.host} cannot be listened on: {error.strerror}. "
                f"`ss -ulnp 'sport = :{self._table.port}'` shows who does; or choose another port in [marker_source]",
                retry_s=_Settings.retry_s,
            ) from error

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def receive(self, until: float) -> Packet | None:
        while self._socket is not None:
            found = received(self._socket, self._clock)
            if found is not None:
                payload, sender, arrived = found
                if self._table.sender in (None, sender[0]):
                    return Packet(payload, f"{sender[0]}:{sender[1]}", arrived)
                self._strangers += 1
                if self._clock.now() >= until:
                    return None
            elif not await_any([self._socket], until, self._clock):
                return None
        return None

    def silence(self) -> str:
        if self._strangers:
            return f"{self._strangers} datagrams came from other addresses than sender: correct sender"
        advice = f"start the program that sends to port {self._table.port} of {self._table.host}"
        if self._table.host.startswith("127."):
            return f'{advice}; from another machine only host = "0.0.0.0" takes them'
        return f"{advice}; does the firewall let them in?"
