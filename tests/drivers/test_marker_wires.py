"""Marker sources on real sockets and through a real zenoh router, on the loopback interface."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from natnet_server import NatnetServer
from sent_markers import table

from bodyschema.daemon.wiring.wiring import stream_of
from bodyschema.drivers.markers.datagram import SCHEMA
from bodyschema.drivers.markers.natnet import packets
from bodyschema.drivers.markers.report import Unusable
from bodyschema.drivers.markers.stream import MarkerStream, stream_checks
from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.cdr import CdrWriter
from bodyschema.drivers.ros2.emulator.zenoh_robot import ZenohRobot
from bodyschema.drivers.ros2.link import open_session
from bodyschema.drivers.ros2.messages import NANO, Header, MessageType, encode_point, encode_pose, write_header
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.records import MarkerFix

LIMIT_S = 400.0
AT = (0.1, 0.2, 0.3)
LEVEL = (0.0, 0.0, 0.0, 1.0)
EVERY_S = 0.004
AHEAD_S = 777.0


def opened(**keys) -> MarkerStream:
    return stream_of(table(**keys), SystemClock())


def first_fix(stream: MarkerStream, accept: Callable[[MarkerFix], bool] = lambda _: True) -> MarkerFix:
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        seen = stream.read(0.5)
        if isinstance(seen, MarkerFix) and accept(seen):
            return seen
    raise AssertionError(f"nothing came: {stream.health}")


@contextmanager
def repeated(act: Callable[[], None]) -> Iterator[None]:
    """Call `act` every few milliseconds meanwhile."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(EVERY_S):
            act()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


# --- UDP


def test_datagrams_are_dated_by_the_kernel() -> None:
    port = free_udp_port()
    with opened(port=port) as stream, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        time.sleep(0.1)  # the kernel dates what comes a moment after the first socket asked for it
        before = time.monotonic()
        out.sendto(json.dumps({"schema": SCHEMA, "position": AT}).encode(), ("127.0.0.1", port))
        after = time.monotonic()
        time.sleep(0.2)
        fix = first_fix(stream)
    assert before - 0.01 < fix.t < after + 0.01
    assert fix.x == pytest.approx(AT)


def test_datagrams_of_other_addresses_are_not_used() -> None:
    port = free_udp_port()
    with opened(port=port, sender="192.0.2.1") as stream, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.sendto(json.dumps({"schema": SCHEMA, "position": AT}).encode(), ("127.0.0.1", port))
        assert stream.read(0.1) is None
        assert "correct sender" in stream._receiver.silence()


def test_taken_port_is_reported() -> None:
    port = free_udp_port()
    with opened(port=port), pytest.raises(SourceLost, match=r"ss -ulnp 'sport = "):
        opened(port=port).__enter__()


def test_doctor_tells_rate_place_and_silence(monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.interfaces.waits.Waits.silent_after_s", 0.3)
    port, seq = free_udp_port(), iter(range(10**6))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:

        def send() -> None:
            told = {"schema": SCHEMA, "position": AT, "stamp": time.monotonic() + AHEAD_S, "seq": next(seq)}
            out.sendto(json.dumps(told).encode(), ("127.0.0.1", port))

        with repeated(send):
            check = next(iter(stream_checks(opened(port=port), SystemClock(), 0.3)))
    assert check.state in ("ok", "warning")
    assert "last at (100.0, 200.0, 300.0) mm ± 1 mm" in check.said
    [silent] = stream_checks(opened(port=port), SystemClock(), 0.3)
    assert silent.state == "wrong"
    assert f"port {port}" in silent.fix


# --- NatNet


def motive(**keys) -> NatnetServer:
    return NatnetServer({1: "table", 2: "tool"}, **keys)


@contextmanager
def streaming(server: NatnetServer, **keys) -> Iterator[MarkerStream]:
    """Yield a stream of the server, which sends two bodies."""

    def act() -> None:
        server.answer()
        server.send({1: ((9.0, 9.0, 9.0), LEVEL), 2: (AT, LEVEL)}, time.monotonic() + AHEAD_S)

    local = {"kind": "natnet", "command_port": server.command_port, "local": "127.0.0.1"}
    with repeated(act), opened(**local, **keys) as stream:
        yield stream


@pytest.mark.parametrize("version", [(3, 0), (3, 1), (4, 0), (4, 1), (4, 2)])
def test_rigid_body_is_read_from_each_version(version) -> None:
    with motive(version=version) as server, streaming(server, body="tool") as stream:
        fix = first_fix(stream)
    assert fix.x == pytest.approx(AT)
    assert not any("another body" in said for said in stream.health)


def test_rigid_body_is_read_from_the_multicast_group() -> None:
    with motive(group="239.255.42.99", data_port=free_udp_port()) as server:
        try:
            with streaming(server, body=2) as stream:
                fix = first_fix(stream)
        except OSError as error:
            pytest.skip(f"no multicast on the loopback interface ({error}); to run it: ip link set lo multicast on")
    assert fix.x == pytest.approx(AT)


def test_motive_s_latency_is_taken_off() -> None:
    with motive() as server, streaming(server, body="tool") as stream:
        fix = first_fix(stream, lambda fix: fix.t_sigma < 0.02)
        assert fix.t < time.monotonic() - 0.003


def test_bodies_without_names_go_by_their_ids(monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.drivers.markers.natnet.client._Settings.answer_s", 0.2)
    with NatnetServer({}) as server, streaming(server, body=2) as stream:
        assert first_fix(stream).x == pytest.approx(AT)


def test_absent_motive_is_reported(monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.drivers.markers.natnet.client._Settings.answer_s", 0.2)
    with pytest.raises(SourceLost, match="no NatNet server answers on"):
        opened(kind="natnet", command_port=free_udp_port()).__enter__()


def test_old_motive_is_reported() -> None:
    with (
        motive(version=(2, 9)) as server,
        pytest.raises(SourceError, match=r"streams NatNet 2\.9; this program reads 3\.0"),
        streaming(server),
    ):
        pass


@pytest.mark.parametrize("version", [(3, 1), (4, 1)])
def test_damaged_frames_are_refused_at_every_byte(version) -> None:
    contents = motive(version=version).frame({2: (AT, LEVEL)}, 5.0)[packets.HEADER.size :]
    assert packets.frame(contents, version).bodies[0].x == pytest.approx(AT)
    end = contents.rfind(b"\0" * 6) - 20  # behind the stamps nothing is read
    for size in range(0, end, 7):
        with pytest.raises(Unusable):
            packets.frame(contents[:size], version)
    rng = np.random.default_rng(0)
    for _ in range(300):
        broken = bytearray(contents)
        broken[rng.integers(len(broken))] ^= int(rng.integers(1, 256))
        with suppress(Unusable):
            packets.frame(bytes(broken), version)


def test_frames_are_as_another_client_reads_them() -> None:
    natnet = pytest.importorskip("natnet", reason="no natnet; to run it: pip install natnet")
    from natnet.packet_buffer import PacketBuffer
    from natnet.version import Version

    contents = motive(version=(4, 1)).frame({2: (AT, LEVEL)}, 5.0)[packets.HEADER.size :]
    theirs = natnet.DataFrame.read_from_buffer(PacketBuffer(contents), Version(4, 1))
    assert [body.pos for body in theirs.rigid_bodies] == [body.x for body in packets.frame(contents, (4, 1)).bodies]


# --- zenoh and ROS 2


@contextmanager
def published(endpoint: str, name: str, payload: Callable[[int], bytes], **keys) -> Iterator[MarkerStream]:
    """Yield a stream through a router, on which a program publishes under `name`; `payload` is given a stamp [ns]."""
    with ZenohRobot([], endpoint), opened(router=endpoint, **keys) as stream:
        session = open_session(endpoint)
        seq = iter(range(1, 10**6))

        def put() -> None:
            stamp_ns = time.monotonic_ns() + 777 * NANO
            session.put(name, payload(stamp_ns), attachment=rmw.attachment(next(seq), stamp_ns, b"g" * 16))

        try:
            with repeated(put):
                yield stream
        finally:
            session.close()


def test_json_is_read_from_a_zenoh_key(endpoint) -> None:
    def told(stamp_ns: int) -> bytes:
        return json.dumps({"schema": SCHEMA, "position": AT, "stamp": 1e-9 * stamp_ns}).encode()

    with published(endpoint, "lab/marker", told, kind="zenoh", key="lab/marker") as stream:
        assert first_fix(stream).x == pytest.approx(AT)


def test_absent_router_is_reported(endpoint) -> None:
    with pytest.raises(SourceLost, match="Start zenohd there"):
        opened(kind="zenoh", router=endpoint).__enter__()


def pose(stamp_ns: int) -> bytes:
    writer = CdrWriter()
    write_header(writer, Header(stamp_ns, "world"))
    writer.float64_array(AT)
    writer.float64_array(LEVEL)
    return writer.to_bytes()


def tf(stamp_ns: int) -> bytes:
    writer = CdrWriter()
    writer.uint32(2)
    for child, x in (("table", (5.0, 5.0, 5.0)), ("tool", AT)):
        write_header(writer, Header(stamp_ns, "world"))
        writer.string(child)
        writer.float64_array(x)
        writer.float64_array(LEVEL)
    return writer.to_bytes()


def with_covariance(stamp_ns: int) -> bytes:
    covariance = np.diag([4e-6, 4e-6, 9e-6, 1e-4, 1e-4, 1e-4]).ravel()
    return encode_pose(Header(stamp_ns, "world"), AT, LEVEL, tuple(covariance.tolist()))


MESSAGES = {
    "pose": ("geometry_msgs::msg::dds_::PoseStamped_", pose),
    "point": ("geometry_msgs::msg::dds_::PointStamped_", lambda stamp: encode_point(Header(stamp, "world"), AT)),
    "pose_with_covariance": ("geometry_msgs::msg::dds_::PoseWithCovarianceStamped_", with_covariance),
    "tf": ("tf2_msgs::msg::dds_::TFMessage_", tf),
}


@pytest.mark.parametrize("message", list(MESSAGES))
def test_topics_are_read_from_rmw_zenoh(endpoint, message) -> None:
    name, payload = MESSAGES[message]
    key = rmw.topic_key(3, "/mocap/tool", MessageType(name, "RIHS01_0"))
    keys = {"kind": "ros2", "domain": 3, "topic": "/mocap/tool", "message": message}
    keys |= {"child": "tool"} if message == "tf" else {}
    with published(endpoint, key, payload, **keys) as stream:
        fix = first_fix(stream)
    assert fix.x == pytest.approx(AT)
    if message == "pose_with_covariance":
        np.testing.assert_allclose(fix.cov, np.diag([4e-6, 4e-6, 9e-6]))


def test_topic_is_read_from_the_dds_bridge(endpoint) -> None:
    keys = {"kind": "ros2", "via": "ros2dds", "topic": "/mocap/tool"}
    with published(endpoint, "mocap/tool", pose, **keys) as stream:
        assert first_fix(stream).x == pytest.approx(AT)


def test_position_in_another_frame_is_named(endpoint) -> None:
    keys = {"kind": "ros2", "via": "ros2dds", "topic": "/tool", "frame": "camera"}
    with published(endpoint, "tool", pose, **keys) as stream:
        end = time.monotonic() + LIMIT_S
        while not stream.health and time.monotonic() < end:
            assert stream.read(0.1) is None
        assert "are in another frame ('world', not 'camera'): correct frame" in stream.health[0]
