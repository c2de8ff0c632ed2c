"""Create the marker sources that robot.toml asks for."""

from __future__ import annotations

from bodyschema.interfaces.protocols import Clock

from .config import AnySource, NatnetTable, Ros2Table, UdpTable, ZenohTable
from .datagram import decode_datagram
from .keys import KeyReceiver, topic_receiver
from .natnet.client import NatnetReceiver
from .stream import MarkerStream
from .udp import UdpReceiver


def stream_of(table: AnySource, clock: Clock) -> MarkerStream:
    """Return the source, not opened yet; `clock` has to be the machine's monotonic one."""
    match table:
        case UdpTable():
            return MarkerStream(table, UdpReceiver(table, clock), decode_datagram, clock)
        case ZenohTable():
            return MarkerStream(table, KeyReceiver(table, table.key, clock), decode_datagram, clock)
        case NatnetTable():
            motive = NatnetReceiver(table, clock)
            return MarkerStream(table, motive, motive.decode, clock)
        case Ros2Table():
            return MarkerStream(table, *topic_receiver(table, clock), clock)
