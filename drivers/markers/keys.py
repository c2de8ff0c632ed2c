"""Receive messages on a zenoh key: JSON of any program, or the CDR of ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.link import RETRY_S, ZenohLink, open_session
from bodyschema.interfaces.errors import SourceLost
from bodyschema.interfaces.protocols import Clock

from .config import Ros2Table, ZenohTable
from .report import Packet, Report
from .transforms import TYPES, decoder


class KeyReceiver:
    """A subscription to one key."""

    def __init__(self, table: ZenohTable | Ros2Table, key: str, clock: Clock) -> None:
        self._table, self._key, self._clock = table, key, clock
        self._link: ZenohLink | None = None

    def open(self) -> None:
        """Subscribe. Raise SourceLost when the router is not there."""
        try:
            session = open_session(self._table.router)
        except SourceLost as error:
            if isinstance(self._table, Ros2Table):
                raise
            raise SourceLost(
                f"no zenoh router answers on {self._table.router}. Start zenohd there, or correct router in "
                "[marker_source]",
                retry_s=RETRY_S,
            ) from error
        try:
            self._link = ZenohLink(session, self._key, self._clock)
        except BaseException:
            session.close()
            raise

    def close(self) -> None:
        """End the subscription."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def receive(self, until: float) -> Packet | None:
        """Return the next message; None when none arrives by `until` [s].

        Raises:
            SourceLost: the router is gone.
        """
        if self._link is None:
            return None
        sample = self._link.receive(until)
        if sample is None:
            if not self._link.is_connected:
                raise SourceLost(f"the zenoh router {self._table.router} is gone", retry_s=RETRY_S)
            return None
        gid, _ = rmw.sender_of(sample.attached)
        return Packet(sample.payload, gid.hex(), sample.arrived, sample.attached)

    def silence(self) -> str:
        """Return why nothing may be coming, and what to do."""
        if isinstance(self._table, ZenohTable):
            return f"let a program publish on the key {self._key} at {self._table.router}"
        topics = [] if self._link is None else list(rmw.topics_in(list(self._link.tokens())))
        wanted = "/" + self._table.topic.strip("/")
        types = {topic.type for topic in topics if topic.name == wanted}
        if types and TYPES[self._table.message] not in types:
            return f"{wanted} is a topic of {', '.join(sorted(types))}: correct message in [marker_source]"
        alike = sorted({topic.name for topic in topics if topic.type == TYPES[self._table.message]} - {wanted})
        if alike:
            return f"there are such messages on {', '.join(alike)}: correct topic in [marker_source]"
        return f"start the node that publishes {wanted}, on the router {self._table.router}"


def topic_receiver(table: Ros2Table, clock: Clock) -> tuple[KeyReceiver, Callable[[bytes, bytes], Iterable[Report]]]:
    """Return the subscription to a ROS 2 topic, and what decodes its messages."""
    topic = table.topic.strip("/")
    if table.via == "ros2dds":
        return KeyReceiver(table, topic, clock), decoder(table)
    key = f"{table.domain}/{topic}/{TYPES[table.message]}/{rmw.ANY}"
    return KeyReceiver(table, key, clock), decoder(table)
