"""Talk to a NatNet server: ask for its version, join its stream, and notice when it is gone."""

from __future__ import annotations

import errno
import math
import socket
from collections.abc import Callable, Iterator

from bodyschema.drivers.markers.config import NatnetTable
from bodyschema.drivers.markers.report import Packet, Report, Unusable
from bodyschema.drivers.markers.udp import await_any, listening, received
from bodyschema.drivers.ros2.messages import NANO
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.protocols import Clock

from . import packets
from .packets import Message, ServerInfo


class _Settings:
    answer_s, ask_every_s = 2.0, 0.4  # how long the server is waited for, and how often it is asked meanwhile
    retry_s: float = 10.0  # opening takes `answer_s` where no server is
    alive_every_s: float = 1.0  # a server forgets clients that are silent for seconds
    gone_after_s: float = 4.0  # a server that is silent for so long


class NatnetReceiver:
    """The stream of a NatNet server, by multicast or unicast, depending on the server's settings."""

    def __init__(self, table: NatnetTable, clock: Clock) -> None:
        self._table, self._clock = table, clock
        self._commands: socket.socket | None = None
        self._data: socket.socket | None = None
        self.server: ServerInfo | None = None
        self.names: dict[int, str] = {}  # names of the rigid bodies by streaming ID
        self._frames = 0
        self._heard = self._asked = self._asked_names = -math.inf

    def open(self) -> None:
        """Request the server's version and join its stream.

        Raises:
            SourceLost: it does not answer.
            SourceError: it speaks another version of NatNet.
        """
        self.server, self.names, self._frames = None, {}, 0
        try:
            self._commands = listening("0.0.0.0", 0)
            self._await_server()
            self._join()
            until = self._clock.now() + _Settings.answer_s  # without an answer, bodies are identified by ID only
            while not self.names and self._clock.now() < until:
                self._ask(packets.packet(Message.REQUEST_MODEL), lambda: bool(self.names))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        for found in (self._commands, self._data):
            if found is not None:
                found.close()
        self._commands = self._data = None

    def receive(self, until: float) -> Packet | None:
        while True:
            self._keep_alive()
            sockets = [found for found in (self._data, self._commands) if found is not None]
            got = next(filter(None, (received(found, self._clock) for found in sockets)), None)
            packet = None if got is None else self._sorted(*got)
            if packet is not None:
                return packet
            now = self._clock.now()
            if now >= until:
                return None
            if got is None:
                await_any(sockets, min(until, now + _Settings.alive_every_s), self._clock)

    def silence(self) -> str:
        if self.server is None:
            return "start Motive"
        if self.server.group:
            return (
                f"Motive answers, but no frame of the multicast group {self.server.group} arrives: set local to this "
                "machine's address in that network, or Transmission Type: Unicast in Motive"
            )
        return "Motive answers, but sends no frames: start its live mode, and check Rigid Bodies in Data Streaming"

    def decode(self, payload: bytes, _: bytes = b"") -> Iterator[Report]:
        """Yield the rigid bodies of a frame; raise Unusable if it is damaged."""
        if self.server is None:
            return
        found = packets.frame(payload, self.server.version)
        rate = self.server.ticks_per_s
        is_dated = rate > 0 and found.exposed > 0 and found.sent >= found.exposed
        stamp_ns = found.sent * NANO // rate if is_dated else round(found.time_s * NANO)
        age_s = (found.sent - found.exposed) / rate if is_dated else 0.0
        now = self._clock.now()
        if (
            any(body.id not in self.names for body in found.bodies)
            and now - self._asked_names > _Settings.alive_every_s
        ):
            self._asked_names = now
            self._send(packets.packet(Message.REQUEST_MODEL))
        for body in found.bodies:
            yield Report(
                x=body.x if body.is_tracked else None,
                stamp_ns=stamp_ns,
                age_s=age_s,
                seq=found.number,
                turn=body.turn,
                spread=body.error,
                body=self.names.get(body.id, str(body.id)),
                where=(str(body.id),),
            )

    def _await_server(self) -> None:
        begin = self._clock.now()
        while self.server is None and self._commands is not None:
            now = self._clock.now()
            if now - begin > _Settings.answer_s:
                raise SourceLost(
                    f"no NatNet server answers on {self._table.server}:{self._table.command_port}. Start Motive, "
                    "switch on its Data Streaming on that network interface, and let its firewall pass UDP",
                    retry_s=_Settings.retry_s,
                )
            self._ask(packets.connect(), lambda: self.server is not None)
        if self.server is not None and not packets.OLDEST <= self.server.version[0] <= packets.NEWEST:
            major, minor = self.server.version
            raise SourceError(
                f"{self.server.application} streams NatNet {major}.{minor}; this program reads 3.0 to 4.x. Update "
                "Motive to 2.0 or later"
            )

    def _ask(self, question: bytes, is_answered: Callable[[], bool]) -> None:
        """Send a question and process received packets until it is answered, for `ask_every_s` at most."""
        self._send(question)
        until = self._clock.now() + _Settings.ask_every_s
        # Frames may arrive without a pause, so check the time too.
        while not is_answered() and self._commands is not None and self._clock.now() < until:
            if await_any([self._commands], until, self._clock):
                got = received(self._commands, self._clock)
                if got is not None:
                    self._sorted(*got)

    def _join(self) -> None:
        """Join the multicast group, if the server sends to one."""
        if self.server is None or not self.server.group:
            return
        group, local = socket.inet_aton(self.server.group), socket.inet_aton(self._table.local)
        try:
            self._data = listening(self.server.group, self.server.data_port, shared=True)
            self._data.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group + local)
        except OSError as error:
            raise SourceLost(
                f"the multicast group {self.server.group}:{self.server.data_port} cannot be joined: {error.strerror}. "
                "Set local in [marker_source] to this machine's address in Motive's network, or Transmission Type: "
                "Unicast in Motive",
                retry_s=_Settings.retry_s,
            ) from error

    def _send(self, data: bytes) -> None:
        """Send a command; an absent server is detected by its silence."""
        self._asked = self._clock.now()
        if self._commands is None:
            return
        try:
            self._commands.sendto(data, (self._table.server, self._table.command_port))
        except OSError as error:
            if error.errno not in (errno.ECONNREFUSED, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN):
                raise

    def _keep_alive(self) -> None:
        now = self._clock.now()
        if now - self._heard > _Settings.gone_after_s:
            raise SourceLost(f"the NatNet server {self._table.server} has fallen silent", retry_s=_Settings.retry_s)
        if now - self._asked > _Settings.alive_every_s:
            # CONNECT is answered, so a server without frames still shows that it is alive.
            self._send(packets.packet(Message.KEEP_ALIVE))
            self._send(packets.connect())

    def _sorted(self, data: bytes, sender: tuple[str, int], arrived: float) -> Packet | None:
        """Return the frame in a packet; process packets of any other kind and return None."""
        if sender[0] != self._table.server:
            return None
        self._heard = arrived
        try:
            message, contents = packets.opened(data)
            if message == Message.SERVER_INFO:
                self.server = packets.server_info(contents)
            elif message == Message.MODEL and self.server is not None:
                self.names = packets.body_names(contents, self.server.version)
            elif message == Message.FRAME:
                return Packet(contents, self._table.server, arrived)
        except Unusable:
            # Pass it on as a frame, so that the stream rejects and counts it with its reason.
            return Packet(data[packets.HEADER.size :][:8], self._table.server, arrived)
        return None
