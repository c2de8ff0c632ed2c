"""Emulate Motive: a NatNet server on real sockets, for NatNet 3.0 to 4.1, by multicast or to each client alone."""

from __future__ import annotations

import socket
import struct
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from bodyschema.drivers.markers.natnet import packets
from bodyschema.drivers.markers.natnet.packets import HEADER, Message, Version

TICKS_PER_S = 10_000_000
Pose = tuple[tuple[float, float, float], tuple[float, float, float, float]]
UNSEEN_LABEL = 7


class NatnetServer:
    """A server that answers commands and sends the frames that it is told to.

    Attributes:
        command_port: where it answers.
    """

    def __init__(
        self,
        bodies: Mapping[int, str],
        version: Version = (4, 1),
        *,
        group: str = "",
        data_port: int = 0,
        host: str = "127.0.0.1",
        program: Version = (3, 1),
    ) -> None:
        """Prepare without opening anything.

        Args:
            bodies: names of the rigid bodies by streaming ID.
            version: of NatNet.
            group: multicast address; empty to send to each client that connects.
            data_port: of the group.
            host: address of its network interface.
            program: version of the program.
        """
        self._bodies, self._version, self._program = dict(bodies), version, program
        self._group, self._data_port, self._host = group, data_port, host
        self._socket: socket.socket | None = None
        self._clients: dict[tuple[str, int], None] = {}
        self._number = 0
        self.command_port = 0

    def __enter__(self) -> Self:
        self._socket = found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        found.bind((self._host, 0))
        found.setblocking(False)
        if self._group:
            found.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(self._host))
            found.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        self.command_port = found.getsockname()[1]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def answer(self) -> None:
        """Answer all commands that have arrived."""
        while self._socket is not None:
            try:
                data, client = self._socket.recvfrom(2048)
            except BlockingIOError:
                return
            message = HEADER.unpack_from(data)[0]
            if message == Message.CONNECT:
                self._clients[client] = None
                self._socket.sendto(packets.packet(Message.SERVER_INFO, self._information()), client)
            elif message == Message.REQUEST_MODEL:
                self._socket.sendto(packets.packet(Message.MODEL, self._models()), client)

    def send(
        self, poses: Mapping[int, Pose | None], t: float, *, latency_s: float = 0.004, error: float = 2e-4
    ) -> None:
        """Send a frame, exposed at `t` [s] on the server's clock; a pose of None is a body that was not seen."""
        self.send_packet(self.frame(poses, t, latency_s=latency_s, error=error))

    def frame(
        self, poses: Mapping[int, Pose | None], t: float, *, latency_s: float = 0.004, error: float = 2e-4
    ) -> bytes:
        """Return the packet of the next frame."""
        self._number += 1
        rows = [
            packets.BODY.pack(body, *(pose or ((0.0,) * 3, (0.0, 0.0, 0.0, 1.0)))[0], *(pose or ((), (0.0,) * 4))[1],
                              error, int(pose is not None))
            for body, pose in poses.items()
        ]  # fmt: skip
        loose = struct.pack("<3f", 0.1, 0.2, 0.3)
        labelled = struct.pack("<i4fhf", UNSEEN_LABEL, 0.1, 0.2, 0.3, 0.014, 0, 1e-4)
        marker_set = b"all\0" + struct.pack("<i", 1) + loose
        skeleton = struct.pack("<ii", 3, 1) + packets.BODY.pack(5, 0, 0, 0, 0, 0, 0, 1, 0, 1)
        plate = struct.pack("<iii2f", 1, 1, 2, 0.5, 0.6)
        sections = [[marker_set], [loose], rows, [skeleton]]
        if self._version >= packets.SIZED_SINCE:
            sections.append([struct.pack("<iii", 9, 0, 0)])
        sections += [[labelled], [plate], []]
        contents = struct.pack("<i", self._number) + b"".join(self._section(section) for section in sections)
        exposed, sent = round(t * TICKS_PER_S), round((t + latency_s) * TICKS_PER_S)
        contents += packets.STAMPS.pack(0, 0, t, exposed, exposed + 10, sent)
        if self._version >= packets.SIZED_SINCE:
            contents += struct.pack("<II", 0, 0)
        return packets.packet(Message.FRAME, contents + struct.pack("<hi", 0, 0))

    def send_packet(self, data: bytes) -> None:
        """Send a packet to the group, or to all clients."""
        if self._socket is None:
            return
        for client in [(self._group, self._data_port)] if self._group else list(self._clients):
            self._socket.sendto(data, client)

    def _section(self, rows: list[bytes]) -> bytes:
        data = b"".join(rows)
        size = struct.pack("<i", len(data)) if self._version >= packets.SIZED_SINCE else b""
        return struct.pack("<i", len(rows)) + size + data

    def _information(self) -> bytes:
        group = socket.inet_aton(self._group or "0.0.0.0")
        return packets.SERVER.pack(b"Motive", *self._program, 0, 0, *self._version, 0, 0) + packets.SERVER_CLOCK.pack(
            TICKS_PER_S, self._data_port, bool(self._group), *group
        )

    def _models(self) -> bytes:
        rows = [struct.pack("<i", 0) + self._sized(b"all\0" + struct.pack("<i", 1) + b"m1\0")]
        for body, name in self._bodies.items():
            rest = struct.pack("<ii3f", body, -1, 0, 0, 0)
            if self._version >= (4, 2):
                rest += struct.pack("<4f", 0, 0, 0, 1)
            rest += struct.pack("<i3fi", 1, 0.01, 0, 0, 1) + (b"m1\0" if self._version >= (4, 0) else b"")
            rows.append(struct.pack("<i", 1) + self._sized(name.encode() + b"\0" + rest))
        return struct.pack("<i", len(rows)) + b"".join(rows)

    def _sized(self, data: bytes) -> bytes:
        return (struct.pack("<i", len(data)) if self._version >= packets.SIZED_SINCE else b"") + data
