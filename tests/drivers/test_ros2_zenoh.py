"""ROS 2 over zenoh on the loopback interface: router, reader and publisher in one process."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
import zenoh
from ros2_robot import PATHS

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.config import MarkerTopic, Ros2Config
from bodyschema.drivers.ros2.emulator.node import EPOCH_NS, Node
from bodyschema.drivers.ros2.emulator.zenoh_robot import ZenohRobot
from bodyschema.drivers.ros2.joints import Ros2Joints
from bodyschema.drivers.ros2.link import open_session
from bodyschema.drivers.ros2.marker import MarkerPublisher
from bodyschema.drivers.ros2.messages import POINT_STAMPED, POSE_WITH_COVARIANCE_STAMPED, Header, encode_point
from bodyschema.drivers.ros2.senders import Refusal
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceLost

LIMIT_S = 300.0
NAMES = ("pan", "lift", "elbow")


def robot(endpoint: str, **settings) -> ZenohRobot:
    return ZenohRobot([Node(PATHS, 200.0)], endpoint, **settings)


def joints(endpoint: str, **settings) -> Ros2Joints:
    return Ros2Joints(Ros2Config(router=endpoint, **settings), NAMES, SystemClock())


def first(source: Ros2Joints):
    """Return the first reading that arrives."""
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        reading = source.read(0.5)
        if reading is not None:
            return reading
    raise AssertionError("nothing came")


def read_on(source: Ros2Joints) -> None:
    """Read until an error comes."""
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        source.read(0.5)


def test_joint_states_are_read_through_the_router(endpoint) -> None:
    with robot(endpoint) as arm, joints(endpoint) as source:
        arm.start()
        reading = first(source)
    assert reading.q == pytest.approx([PATHS[name](reading.t) for name in NAMES], abs=0.05)
    assert set(source.refused) <= {Refusal.DELAYED}  # a busy machine holds messages up


def test_namespace_and_domain_are_told_apart(endpoint) -> None:
    with robot(endpoint, domain=7, topic="/arm/joint_states") as arm, joints(endpoint) as other:
        arm.start()
        with joints(endpoint, domain=7, topic="/arm/joint_states") as source:
            first(source)
        assert other.read(0.0) is None
    assert other.received == 0


def test_dds_robot_joints_are_read_through_bridge(endpoint) -> None:
    with robot(endpoint, topic="/arm/joint_states", via="ros2dds") as arm:
        arm.start()
        with joints(endpoint, topic="/arm/joint_states", via="ros2dds") as source:
            reading = first(source)
    assert reading.q == pytest.approx([PATHS[name](reading.t) for name in NAMES], abs=0.05)


def test_a_bridge_that_passes_on_nothing_is_named(endpoint) -> None:
    with robot(endpoint, via="ros2dds"), joints(endpoint, via="ros2dds") as source:
        deadline = time.monotonic() + LIMIT_S
        while not source.health and time.monotonic() < deadline:
            source.read(0.5)
    assert "the bridge at" in source.health[0]


def test_missing_router_error_names_the_start_command(endpoint) -> None:
    with pytest.raises(SourceLost, match="ros2 run rmw_zenoh_cpp rmw_zenohd"), joints(endpoint):
        pass


def test_lost_router_is_reported_and_reading_resumes(endpoint) -> None:
    source = joints(endpoint)
    with robot(endpoint) as arm, source:
        arm.start()
        before = first(source)
        arm.__exit__(None, None, None)
        with pytest.raises(SourceLost, match=r"router .* is gone"):
            read_on(source)
    with robot(endpoint) as arm, source:
        arm.start()
        assert first(source).t > before.t


# --- the marker's topic


@pytest.fixture
def router(endpoint) -> Iterator[str]:
    with robot(endpoint):
        yield endpoint


@pytest.mark.parametrize(("message", "kind"), [("point", POINT_STAMPED), ("pose", POSE_WITH_COVARIANCE_STAMPED)])
def test_marker_is_published_like_an_rmw_zenoh_node(router, message, kind) -> None:
    marker = MarkerTopic(frame="eye", message=message)
    x, sigma = np.array([0.1, -0.2, 0.3]), np.array([1e-3, 1e-3, 2e-3])
    with open_session(router) as session, MarkerPublisher(Ros2Config(router=router, domain=3), marker) as published:
        heard = session.declare_subscriber(rmw.topic_key(3, "/bodyschema/marker", kind), zenoh.handlers.RingChannel(10))
        samples = []
        deadline = time.monotonic() + LIMIT_S
        while not samples and time.monotonic() < deadline:
            published.publish(EPOCH_NS, x, sigma)
            samples = [sample for sample in (heard.try_recv(),) if sample is not None]
    payload, attached = samples[0].payload.to_bytes(), samples[0].attachment.to_bytes()
    assert payload.startswith(encode_point(Header(EPOCH_NS, "eye"), (0.1, -0.2, 0.3)))
    assert len(payload) == len(encode_point(Header(EPOCH_NS, "eye"), (0.1, -0.2, 0.3))) + (
        0 if message == "point" else 320
    )
    gid, sequence = rmw.sender_of(attached)
    assert len(gid) == 16
    assert sequence is not None
    assert sequence >= 1


def test_open_marker_topic_is_in_the_graph(router) -> None:
    with open_session(router) as session, MarkerPublisher(Ros2Config(router=router), MarkerTopic(frame="eye")):
        wanted = rmw.Topic(0, "/bodyschema/marker", POINT_STAMPED.name)
        assert any(wanted in rmw.topics_in([token]) for token in tokens_as_they_come(session, rmw.publishers_key()))
        nodes = tokens_as_they_come(session, "@ros2_lv/0/*/*/*/NN/**")
        assert any(token.endswith("/NN/%/%/bodyschema") for token in nodes)


def tokens_as_they_come(session: zenoh.Session, key: str) -> Iterator[str]:
    """Yield the tokens that the router already knows, and those that reach it within the limit."""
    channel = zenoh.handlers.FifoChannel(100)
    subscriber = session.liveliness().declare_subscriber(key, channel, history=True)
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        if (sample := subscriber.try_recv()) is not None:
            yield str(sample.key_expr)
