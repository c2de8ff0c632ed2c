"""The ROS 2 messages that carry a marker's position."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.cdr import CdrReader
from bodyschema.drivers.ros2.messages import Header, read_header

from .config import Ros2Table
from .report import Fault, Report, Unusable

TYPES = {
    "pose": "geometry_msgs::msg::dds_::PoseStamped_",
    "point": "geometry_msgs::msg::dds_::PointStamped_",
    "pose_with_covariance": "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_",
    "transform": "geometry_msgs::msg::dds_::TransformStamped_",
    "tf": "tf2_msgs::msg::dds_::TFMessage_",
}
SMALLEST_TRANSFORM = 72  # bytes: stamp, two names, seven numbers


def decoder(table: Ros2Table) -> Callable[[bytes, bytes], Iterator[Report]]:
    """Return what decodes the messages of `table` from CDR and rmw_zenoh's attachment.

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
    header: Header,
    x: tuple[float, ...],
    turn: tuple[float, ...] | None,
    cov: tuple[float, ...] | None,
    seq: int | None,
) -> Report:
    return Report(x, stamp_ns=header.stamp_ns, seq=seq, turn=turn, cov=cov, frame=header.frame.lstrip("/"))
