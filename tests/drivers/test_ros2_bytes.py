"""Messages as bytes, compared with bytes that other programs wrote."""

from __future__ import annotations

import contextlib
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.cdr import LARGEST_MESSAGE, CdrReader, CdrWriter, Malformed
from bodyschema.drivers.ros2.messages import (
    JOINT_STATE,
    NANO,
    POINT_STAMPED,
    Header,
    JointState,
    MessageType,
    decode_joint_state,
    encode_joint_state,
    encode_point,
    encode_pose,
)

STAMP_NS = 1_700_000_000_123_456_789
TWO = JointState(Header(STAMP_NS, "base"), ("elbow", "lift"), (0.5, -0.25), (1.0, -2.0))
GERMAN = JointState(Header(-2 * NANO + 300_000_000, ""), ("a", "bcdefgh", "schulter_größe"), (1.0, 2.0, 3.0))

# Made by rosbags 0.11.9, serialize_cdr with the message definitions of ROS 2 Jazzy. pycdr2 1.0.0 makes the same bytes
# of the first one; it knows no ROS and was given the fields by hand.
ROSBAGS_LITTLE = bytes.fromhex(
    "0001000000f1536515cd5b070500000062617365000000000200000006000000656c626f77000000050000006c696674000000000200000000"
    "000000000000000000e03f000000000000d0bf0200000000000000000000000000f03f00000000000000c000000000"
)
ROSBAGS_BIG = bytes.fromhex(
    "000000006553f100075bcd150000000562617365000000000000000200000006656c626f77000000000000056c69667400000000000000020000"
    "00003fe0000000000000bfd000000000000000000002000000003ff0000000000000c00000000000000000000000"
)
ROSBAGS_GERMAN = bytes.fromhex(
    "00010000feffffff00a3e111010000000000000003000000020000006100000008000000626364656667680011000000736368756c7465725f67"
    "72c3b6c39f65000000000300000000000000000000000000f03f000000000000004000000000000008400000000000000000"
)
ROSBAGS_POINT = bytes.fromhex(
    "0001000000f1536515cd5b070a000000626173655f6c696e6b0000009a9999999999b93f9a9999999999c9bf333333333333d33f"
)

# A Universal Robots arm's message as rclpy serialised it (Fast-CDR), found in the tests of a public telemetry gateway.
# Its padding is uninitialised memory, not zeros.
RCLPY = bytes.fromhex(
    "00010000"
    "00f1536515cd5b07"
    "0a000000626173655f6c696e6b000235"
    "06000000"
    "1300000073686f756c6465725f70616e5f6a6f696e740000"
    "1400000073686f756c6465725f6c6966745f6a6f696e7400"
    "0c000000656c626f775f6a6f696e7400"
    "0e00000077726973745f315f6a6f696e74000235"
    "0e00000077726973745f325f6a6f696e74000000"
    "0e00000077726973745f335f6a6f696e74001030"
    "0600000070160435"
    "9a9999999999b93f"
    "1f85eb51b81ef9bf"
    "1f85eb51b81ef93f"
    "1f85eb51b81ef9bf"
    "1f85eb51b81ef9bf"
    "0000000000000000"
    "0600000070d80235" + 48 * "00" + "060000008098b300" + 48 * "00"
)

# tf2_msgs/TFMessage from the tests of foxglove/cdr (CdrReader.test.ts), which those of mcap (mcap_ros2) have too.
FOXGLOVE_TF = bytes.fromhex(
    "0001000001000000cce0d158f08cf9060a000000626173655f6c696e6b000000060000007261646172000000ae47e17a14ae0e40"
    "000000000000000000000000000000000000000000000000000000000000000000000000000000000000" + "00000000f03f"
)

# geometry_msgs/PoseWithCovarianceStamped as rmw_cyclonedds serialised it, from the tests of an Autoware controller.
CYCLONE_POSE = bytes.fromhex(
    "000100000700000008000000040000006d617000000000000000f83f00000000000002c0000000000000000000000000000000000000000000"
    "000000f0054b74e8aede3f507d5b062815ec3f" + ("9a9999999999b93f" + 48 * "00") * 5 + "9a9999999999b93f"
)

# Caught from rmw_zenoh 0.10 (ROS 2 Lyrical, `ros2 topic pub /chatter`) for the tests of another client of it.
ATTACHMENT = bytes.fromhex("1b0000000000000040a1c53a897cc618101236acd8c8370ad4e6ed96c021a8b85e")
GID = bytes.fromhex("1236acd8c8370ad4e6ed96c021a8b85e")
STRING = MessageType(
    "std_msgs::msg::dds_::String_", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
)
ZID, CLI = "cb6e75cf8194a4d81370b618e0a4ed07", "_ros2cli_413596"


# --- joint states


@pytest.mark.parametrize(("data", "message"), [(ROSBAGS_LITTLE, TWO), (ROSBAGS_BIG, TWO), (ROSBAGS_GERMAN, GERMAN)])
def test_message_written_by_rosbags_is_read(data, message) -> None:
    assert decode_joint_state(data) == message


def test_message_written_by_rclpy_is_read_despite_padding() -> None:
    message = decode_joint_state(RCLPY)
    assert message.header == Header(STAMP_NS, "base_link")
    assert message.names[::5] == ("shoulder_pan_joint", "wrist_3_joint")
    assert message.positions == (0.1, -1.57, 1.57, -1.57, -1.57, 0.0)
    assert message.velocities == message.efforts == (0.0,) * 6


def test_emulator_message_matches_rosbags() -> None:
    assert encode_joint_state(TWO) == ROSBAGS_LITTLE
    assert encode_joint_state(TWO, big_endian=True) == ROSBAGS_BIG
    assert encode_joint_state(GERMAN) == ROSBAGS_GERMAN


def test_empty_text_needs_no_zero_byte() -> None:
    data = struct.pack("<4sIIIIIII", b"\0\1\0\0", 5, 0, 0, 0, 0, 0, 0)
    assert decode_joint_state(data) == JointState(Header(5 * NANO), ())


def test_foxglove_s_example_is_read_field_by_field() -> None:
    reader = CdrReader(FOXGLOVE_TF)
    assert (reader.uint32(), reader.int32(), reader.uint32()) == (1, 1490149580, 117017840)
    assert (reader.string(), reader.string()) == ("base_link", "radar")


def test_foxglove_s_example_is_written() -> None:
    writer = CdrWriter()
    for number in (1, 1490149580, 117017840):
        writer.uint32(number)
    writer.string("base_link")
    writer.string("radar")
    writer.float64_array((3.835, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    assert writer.to_bytes() == FOXGLOVE_TF


# --- published messages


def test_a_point_is_written_as_rosbags_writes_it() -> None:
    assert encode_point(Header(STAMP_NS, "base_link"), (0.1, -0.2, 0.3)) == ROSBAGS_POINT


def test_pose_bytes_match_rmw_cyclonedds() -> None:
    covariance = tuple(0.1 if place % 7 == 0 else 0.0 for place in range(36))
    turn = (0.0, 0.0, math.sin(0.5), math.cos(0.5))
    assert encode_pose(Header(7 * NANO + 8, "map"), (1.5, -2.25, 0.0), turn, covariance) == CYCLONE_POSE


# --- refused messages


@pytest.mark.parametrize("data", [ROSBAGS_LITTLE, ROSBAGS_BIG, ROSBAGS_GERMAN, RCLPY])
def test_every_truncated_message_is_refused(data) -> None:
    for size in range(len(data)):
        with pytest.raises(Malformed):
            decode_joint_state(data[:size])


def test_anything_after_the_end_is_refused() -> None:
    with pytest.raises(Malformed, match="1 bytes after the end"):
        decode_joint_state(ROSBAGS_LITTLE + b"\0")


def test_oversized_message_is_refused_unread() -> None:
    with pytest.raises(Malformed, match="more than a message"):
        decode_joint_state(bytes(LARGEST_MESSAGE + 1))


@pytest.mark.parametrize("representation", [b"\0\2", b"\0\3", b"\0\6", b"\0\7", b"\1\1"])
def test_other_representations_are_refused(representation) -> None:
    with pytest.raises(Malformed, match="neither CDR_LE nor CDR_BE"):
        decode_joint_state(representation + ROSBAGS_LITTLE[2:])


def test_length_beyond_the_message_is_refused() -> None:
    data = bytearray(ROSBAGS_LITTLE)
    data[12:16] = b"\xff\xff\xff\xff"
    with pytest.raises(Malformed, match="4294967295 elements"):
        decode_joint_state(bytes(data))


def test_value_count_must_match_name_count() -> None:
    with pytest.raises(Malformed, match="2 names, but 3 values"):
        decode_joint_state(encode_joint_state(JointState(Header(1), ("a", "b"), (1.0, 2.0, 3.0))))


def test_text_with_inner_zero_byte_is_refused() -> None:
    with pytest.raises(Malformed, match="does not end"):
        decode_joint_state(ROSBAGS_LITTLE.replace(b"elbow", b"el\0ow"))


def test_a_second_has_no_more_than_its_nanoseconds() -> None:
    data = bytearray(ROSBAGS_LITTLE)
    data[8:12] = struct.pack("<I", NANO)
    with pytest.raises(Malformed, match="nanoseconds"):
        decode_joint_state(bytes(data))


@given(st.binary(max_size=300))
def test_any_bytes_are_a_message_or_refused(data) -> None:
    for head in (b"", b"\0\1\0\0", b"\0\0\0\0"):
        with contextlib.suppress(Malformed):
            assert isinstance(decode_joint_state(head + data), JointState)


@given(st.data())
def test_corrupted_message_is_decoded_or_refused(data) -> None:
    spoilt = bytearray(data.draw(st.sampled_from([ROSBAGS_LITTLE, ROSBAGS_BIG, RCLPY])))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(spoilt) - 1))
        patch = data.draw(st.binary(min_size=1, max_size=8))
        spoilt[at : at + len(patch)] = patch
    try:
        message = decode_joint_state(bytes(spoilt))
    except Malformed:
        return
    assert len(message.positions) in (0, len(message.names))


texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)
stamps = st.integers(-(2**31) * NANO, 2**31 * NANO - 1)


@given(st.lists(texts, max_size=8), stamps, texts, st.booleans(), st.data())
def test_every_message_is_read_as_it_was_written(names, stamp_ns, frame, big_endian, data) -> None:
    values = st.lists(st.floats(allow_nan=False), min_size=len(names), max_size=len(names)).map(tuple)
    message = JointState(Header(stamp_ns, frame), tuple(names), data.draw(values), (), data.draw(values))
    assert decode_joint_state(encode_joint_state(message, big_endian=big_endian)) == message


# --- rmw_zenoh


def test_attachment_is_encoded_and_decoded_like_rmw_zenoh() -> None:
    assert rmw.attachment(0x1B, 0x18C67C893AC5A140, GID) == ATTACHMENT
    assert rmw.sender_of(ATTACHMENT) == (GID, 0x1B)


def test_attachment_matches_zenoh_s_own_serialiser() -> None:
    import zenoh.ext

    made = zenoh.ext.z_serialize((zenoh.ext.Int64(7), zenoh.ext.Int64(STAMP_NS), GID))
    assert rmw.attachment(7, STAMP_NS, GID) == made.to_bytes()


def test_the_attachment_of_early_jazzy_is_read_too() -> None:
    import zenoh.ext

    fields = ("sequence_number", zenoh.ext.Int64(7), "source_timestamp", zenoh.ext.Int64(5), "source_gid", GID)
    assert rmw.sender_of(zenoh.ext.z_serialize(fields).to_bytes()) == (GID, 7)


@given(st.binary(max_size=90))
def test_any_other_attachment_tells_nothing(data) -> None:
    gid, sequence = rmw.sender_of(data)
    assert (len(gid), sequence is None) in ((0, True), (16, False))


def test_a_topic_has_the_key_that_was_caught() -> None:
    assert rmw.topic_key(0, "/chatter", STRING) == f"0/chatter/{STRING.name}/{STRING.digest}"
    assert rmw.topic_key(7, "arm/joint_states", JOINT_STATE, rmw.ANY) == f"7/arm/joint_states/{JOINT_STATE.name}/*"


def test_a_node_has_the_token_that_was_caught() -> None:
    assert rmw.node_token(0, ZID, CLI) == f"@ros2_lv/0/{ZID}/0/0/NN/%/%/{CLI}"


def test_publisher_token_matches_capture_except_entity_number() -> None:
    caught = f"@ros2_lv/0/{ZID}/0/4/MP/%/%/{CLI}/%chatter/{STRING.name}/{STRING.digest}/::,10:,:,:,,"
    assert rmw.publisher_token(0, ZID, CLI, "/chatter", STRING) == caught.replace("/0/4/MP/", "/0/1/MP/")


def test_topics_are_extracted_from_tokens() -> None:
    token = rmw.publisher_token(3, ZID, CLI, "/arm/tip", POINT_STAMPED)
    known = [token, rmw.node_token(3, ZID, CLI), "@ros2_lv/x", "", token.replace("lv/3", "lv/three")]
    assert list(rmw.topics_in(known)) == [rmw.Topic(3, "/arm/tip", POINT_STAMPED.name)]


parts = st.one_of(st.sampled_from([rmw.GRAPH, rmw.PUBLISHER, "0", "%", "%arm%tip", "٣", "9" * 5000]), texts)


@given(st.lists(st.lists(parts, max_size=16).map("/".join), max_size=4))
def test_any_other_tokens_are_passed_over(tokens) -> None:
    assert all(0 <= topic.domain < 1000 for topic in rmw.topics_in(tokens))


@given(parts)
def test_token_of_any_domain_is_topic_or_ignored(domain) -> None:
    token = rmw.publisher_token(3, ZID, CLI, "/arm/tip", POINT_STAMPED).replace("lv/3", f"lv/{domain}")
    assert {topic.name for topic in rmw.topics_in([token])} <= {"/arm/tip"}
