"""Receive messages on a zenoh key: JSON of any program, or the CDR of ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack

from bodyschema.drivers.markers.config import Ros2Table, ZenohTable
from bodyschema.drivers.markers.report import Fault, Packet, Report, Unusable
from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.cdr import CdrReader
from bodyschema.drivers.ros2.link import LinkSettings, ZenohLink, open_session
from bodyschema.drivers.ros2.messages import Header, read_header
from bodyschema.interfaces.errors import SourceLost
from bodyschema.interfaces.protocols import Clock

TYPES = {
    "pose": "geometry_msgs::msg::dds_::PoseStamped_",
    "point": "geometry_msgs::msg::dds_::PointStamped_",
    "pose_with_covariance": "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_",
    "transform": "geometry_msgs::msg::dds_::TransformStamped_",
    "tf": "tf2_msgs::msg::dds_::TFMessage_",
}
SMALLEST_TRANSFORM = 72  # bytes: stamp, two names, seven numbers


def decoder(table: Ros2Table) -> Callable[[bytes, bytes], Iterator[Report]]:
    """Return the decoder for messages of `table`, called with their CDR and rmw_zenoh's attachment.

    It raises Malformed for other bytes, and Unusable for a message in another frame.
    """

    def decode(payload: bytes, attached: bytes) -> Iterator[Report]:
        reader = CdrReader(payload)
        _, seq = rmw.sender_of(attached)
        if table.message != "tf":
            yield _required_frame(table, _stamped(reader, table.message, seq))
            return
        for _ in range(reader.count(SMALLEST_TRANSFORM)):
            # Other broadcasters number their messages themselves, so gaps in the numbers mean nothing.
            child, report = _transform(reader, None)
            if child.lstrip("/") == table.child:
                yield _required_frame(table, report)
        reader.end()

    return decode


def _required_frame(table: Ros2Table, report: Report) -> Report:
    if table.frame is not None and report.frame != table.frame:
        raise Unusable(Fault.OTHER_FRAME, f"{report.frame!r}, not {table.frame!r}")
    return report


def _stamped(reader: CdrReader, message: str, seq: int | None) -> Report:
    if message == "transform":
        found = _transform(reader, seq)[1]
        reader.end()
        return found
    header = read_header(reader)
    x = reader.float64_array(3)
    turn = reader.float64_array(4) if message != "point" else None
    cov = reader.float64_array(36) if message == "pose_with_covariance" else None
    reader.end()
    return _report(header, x, turn, cov, seq)


def _transform(reader: CdrReader, seq: int | None) -> tuple[str, Report]:
    """Read geometry_msgs/TransformStamped; return the child's frame and the transform."""
    header, child = read_header(reader), reader.string()
    x, turn = reader.float64_array(3), reader.float64_array(4)
    return child, _report(header, x, turn, None, seq)


def _report(
    header: Header, x: tuple[float, ...], turn: tuple[float, ...] | None, cov: tuple[float, ...] | None, seq: int | None
) -> Report:
    return Report(x, stamp_ns=header.stamp_ns, seq=seq, turn=turn, cov=cov, frame=header.frame.lstrip("/"))


class KeyReceiver:
    """A subscription to one key."""

    def __init__(self, table: ZenohTable | Ros2Table, key: str, clock: Clock) -> None:
        self._table, self._key, self._clock = table, key, clock
        self._link: ZenohLink | None = None

    def open(self) -> None:
        """Subscribe; raise SourceLost if the router is not reachable."""
        try:
            session = open_session(self._table.router)
        except SourceLost as error:
            if isinstance(self._table, Ros2Table):
                raise
            raise SourceLost(
                f"no zenoh router answers on {self._table.router}. Start zenohd there, or correct router in "
                "[marker_source]",
                retry_s=LinkSettings.retry_s,
            ) from error
        with ExitStack() as stack:
            stack.callback(session.close)
            self._link = ZenohLink(session, self._key, self._clock)
            stack.pop_all()

    def close(self) -> None:
        if self._link is not None:
            self._link.close()
            self._link = None

    def receive(self, until: float) -> Packet | None:
        if self._link is None:
            return None
        sample = self._link.receive(until)
        if sample is None:
            if not self._link.is_connected:
                raise SourceLost(f"the zenoh router {self._table.router} is gone", retry_s=LinkSettings.retry_s)
            return None
        gid, _ = rmw.sender_of(sample.attached)
        return Packet(sample.payload, gid.hex(), sample.arrived, sample.attached)

    def silence(self) -> str:
        if isinstance(self._table, ZenohTable):
            return f"let a program publish on the key {self._key} at {self._table.router}"
        topics = [] if self._link is None else list(rmw.topics_in(list(self._link.tokens())))
        topic_name = "/" + self._table.topic.strip("/")
        types = {topic.type for topic in topics if topic.name == topic_name}
        if types and TYPES[self._table.message] not in types:
            return f"{topic_name} is a topic of {', '.join(sorted(types))}: correct message in [marker_source]"
        same_type = sorted({topic.name for topic in topics if topic.type == TYPES[self._table.message]} - {topic_name})
        if same_type:
            return f"there are such messages on {', '.join(same_type)}: correct topic in [marker_source]"
        return f"start the node that publishes {topic_name}, on the router {self._table.router}"


def topic_receiver(table: Ros2Table, clock: Clock) -> tuple[KeyReceiver, Callable[[bytes, bytes], Iterable[Report]]]:
    """Return the subscription to a ROS 2 topic, and the decoder of its messages."""
    topic = table.topic.strip("/")
    if table.via == "ros2dds":
        return KeyReceiver(table, topic, clock), decoder(table)
    key = f"{table.domain}/{topic}/{TYPES[table.message]}/{rmw.ANY}"
    return KeyReceiver(table, key, clock), decoder(table)
