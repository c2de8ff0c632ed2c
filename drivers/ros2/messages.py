"""Encode and decode sensor_msgs/JointState; encode PointStamped, PoseWithCovarianceStamped and tf2_msgs/TFMessage."""

from __future__ import annotations

from dataclasses import dataclass

from .cdr import CdrReader, CdrWriter, Malformed

NANO = 1_000_000_000


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message's type as rmw_zenoh names it."""

    name: str  # the DDS name
    digest: str  # hash of its definition, the same from ROS 2 Iron on (REP-2011)


JOINT_STATE = MessageType(
    "sensor_msgs::msg::dds_::JointState_", "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
)
POINT_STAMPED = MessageType(
    "geometry_msgs::msg::dds_::PointStamped_", "RIHS01_4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897"
)
POSE_WITH_COVARIANCE_STAMPED = MessageType(
    "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_",
    "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
)
TF_MESSAGE = MessageType(
    "tf2_msgs::msg::dds_::TFMessage_", "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
)


@dataclass(frozen=True, slots=True)
class Header:
    """std_msgs/Header."""

    stamp_ns: int  # time since the epoch of the sender's clock [ns]
    frame: str = ""  # name of the frame


@dataclass(frozen=True, slots=True)
class JointState:
    """sensor_msgs/JointState."""

    header: Header
    names: tuple[str, ...]  # of the joints
    # one per name [rad], [m] for a prismatic joint; or none. The same holds for velocities and efforts.
    positions: tuple[float, ...] = ()
    velocities: tuple[float, ...] = ()  # [rad/s] or [m/s]
    efforts: tuple[float, ...] = ()  # [N m] or [N]


def decode_joint_state(data: bytes) -> JointState:
    """Decode a message that extends over all of `data`.

    Raises:
        Malformed: it is not such a message. A false length field never causes a read beyond `data`.
    """
    reader = CdrReader(data)
    message = JointState(read_header(reader), reader.strings(), reader.float64s(), reader.float64s(), reader.float64s())
    reader.end()
    for values in (message.positions, message.velocities, message.efforts):
        if len(values) not in (0, len(message.names)):
            raise Malformed(f"{len(message.names)} names, but {len(values)} values")
    return message


def encode_joint_state(message: JointState, *, big_endian: bool = False) -> bytes:
    writer = CdrWriter(big_endian=big_endian)
    write_header(writer, message.header)
    writer.strings(message.names)
    for values in (message.positions, message.velocities, message.efforts):
        writer.float64s(values)
    return writer.to_bytes()


def encode_point(header: Header, x: tuple[float, ...]) -> bytes:
    """Encode geometry_msgs/PointStamped at `x` [m], 3 numbers."""
    writer = CdrWriter()
    write_header(writer, header)
    writer.float64_array(x)
    return writer.to_bytes()


def encode_pose(
    header: Header, x: tuple[float, ...], quaternion: tuple[float, ...], covariance: tuple[float, ...]
) -> bytes:
    """Encode geometry_msgs/PoseWithCovarianceStamped.

    Args:
        x: position [m], 3 numbers.
        quaternion: orientation (x, y, z, w).
        covariance: of position [m²] and rotations about the fixed axes [rad²], 6 × 6 by rows.
    """
    writer = CdrWriter()
    write_header(writer, header)
    for values in (x, quaternion, covariance):
        writer.float64_array(values)
    return writer.to_bytes()


def encode_transform(header: Header, child: str, x: tuple[float, ...], quaternion: tuple[float, ...]) -> bytes:
    """Encode tf2_msgs/TFMessage with the pose of one frame.

    Args:
        header: of the transform; its frame is the parent.
        x: its position in the parent [m], 3 numbers.
        quaternion: its orientation (x, y, z, w).
    """
    writer = CdrWriter()
    writer.uint32(1)
    write_header(writer, header)
    writer.string(child)
    for values in (x, quaternion):
        writer.float64_array(values)
    return writer.to_bytes()


def read_header(reader: CdrReader) -> Header:
    """Read std_msgs/Header; raise Malformed if its stamp is invalid."""
    seconds, nanoseconds = reader.int32(), reader.uint32()
    if nanoseconds >= NANO:
        raise Malformed(f"{nanoseconds} nanoseconds in a stamp")
    return Header(seconds * NANO + nanoseconds, reader.string())


def write_header(writer: CdrWriter, header: Header) -> None:
    """Write std_msgs/Header."""
    seconds, nanoseconds = divmod(header.stamp_ns, NANO)
    writer.int32(seconds)
    writer.uint32(nanoseconds)
    writer.string(header.frame)
