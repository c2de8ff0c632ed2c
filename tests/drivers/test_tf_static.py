"""examples/tf_static.py publishes a calibrated camera's pose, also to nodes that start later."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import zenoh
import zenoh.ext
from ros2_robot import PATHS

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.emulator.node import Node
from bodyschema.drivers.ros2.emulator.zenoh_robot import ZenohRobot
from bodyschema.drivers.ros2.link import open_session
from bodyschema.drivers.ros2.messages import TF_MESSAGE, Header, encode_transform
from bodyschema.robot.hand_eye import HandEye

EXAMPLES = Path(__file__).parents[2] / "examples"
LIMIT_S = 300.0
POSE = HandEye.of("base_link", "camera", np.array([[0, -1, 0, 1.1], [1, 0, 0, -0.2], [0, 0, 1, 0.3], [0, 0, 0, 1.0]]))


def test_a_node_that_starts_later_gets_the_pose(endpoint, monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    from tf_static import StaticTransform

    told = {name: getattr(POSE, name) for name in ("parent", "child", "translation_m", "quaternion_xyzw")}
    with ZenohRobot([Node(PATHS, 50.0)], endpoint), open_session(endpoint) as session, open_session(endpoint) as later:
        node = StaticTransform(session, told, 3)
        node.publish()
        key = rmw.topic_key(3, "/tf_static", TF_MESSAGE)
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        heard = zenoh.ext.declare_advanced_subscriber(later, key, zenoh.handlers.RingChannel(10), history=history)
        deadline = time.monotonic() + LIMIT_S
        while (sample := heard.try_recv()) is None and time.monotonic() < deadline:
            time.sleep(0.005)
        tokens = [str(reply.ok.key_expr) for reply in later.liveliness().get(rmw.publishers_key()) if reply.ok]
    assert sample is not None
    assert b"camera\x00" in sample.payload.to_bytes()
    (token,) = [token for token in tokens if "%tf_static" in token]
    assert token.endswith(rmw.LATCHED_QOS)


def test_rosbags_reads_transform_with_matching_type_hash() -> None:
    pytest.importorskip("rosbags")
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS2_JAZZY), "tf2_msgs/msg/TFMessage"
    header = Header(1_700_000_000_123_456_789, "base_link")
    data = encode_transform(header, "camera", tuple(POSE.translation_m), tuple(POSE.quaternion_xyzw))
    (read,) = store.deserialize_cdr(data, kind).transforms
    assert (read.header.frame_id, read.child_frame_id, read.header.stamp.nanosec) == ("base_link", "camera", 123456789)
    place, turn = read.transform.translation, read.transform.rotation
    assert [place.x, place.y, place.z] == POSE.translation_m
    assert [turn.x, turn.y, turn.z, turn.w] == POSE.quaternion_xyzw
    assert store.hash_rihs01(kind) == TF_MESSAGE.digest
