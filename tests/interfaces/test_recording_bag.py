"""ROS bags as recordings: the data used, and the questions asked."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from bodyschema.interfaces.errors import RecordingError
from bodyschema.recordings import ros_bag as recording_bag
from bodyschema.recordings.ros_bag import BagTopics, read_bag
from bodyschema.recordings.tracks import JointTrack, MarkerTrack, joined

pytest.importorskip("rosbags")
from written_bags import (
    BEGUN_S,
    joint_state,
    joint_topic,
    point_stamped,
    pose_stamped,
    pose_with_covariance,
    tf,
    write_bag,
)

JOINTS = ("lift", "elbow")
FIXES = {
    "PointStamped": point_stamped,
    "PoseStamped": pose_stamped,
    "PoseWithCovarianceStamped": pose_with_covariance,
    "TFMessage": tf,
}
SECONDS = 4.0


def path(t: np.ndarray) -> np.ndarray:
    return np.column_stack([np.sin(t), 0.5 * np.cos(1.3 * t)])


def place(t: np.ndarray) -> np.ndarray:
    return np.column_stack([path(t), 1.0 + 0.1 * t])


def marker(kind: str = "PointStamped", **of_fix: str) -> tuple[str, list]:
    t = np.arange(0.1, SECONDS - 0.1, 1 / 30)
    return kind, [(at, FIXES[kind](at, x, **of_fix)) for at, x in zip(t.tolist(), place(t), strict=True)]


def states(names: tuple[str, ...] = JOINTS) -> tuple[str, list]:
    return joint_topic(names, path, rate_hz=100.0, seconds=SECONDS)


@pytest.mark.parametrize("mcap", [True, False])
@pytest.mark.parametrize("kind", FIXES)
def test_each_row_has_the_joints_of_its_time(kind, mcap, tmp_path) -> None:
    bag = write_bag(tmp_path / "bag", {"/joint_states": states(), "/tag": marker(kind)}, mcap=mcap)
    read = read_bag(bag, JOINTS, BagTopics(frame="tag_0" if kind == "TFMessage" else None))
    t = np.asarray(read.t) - BEGUN_S
    assert read.q == pytest.approx(path(t), abs=2e-5)
    assert read.x == pytest.approx(place(t), abs=1e-6)


def test_covariances_of_poses_are_kept(tmp_path) -> None:
    bag = write_bag(tmp_path / "bag", {"/js": states(), "/p": marker("PoseWithCovarianceStamped")}, mcap=True)
    read = read_bag(bag, JOINTS, BagTopics())
    assert np.asarray(read.cov)[0] == pytest.approx(np.diag([1e-6, 1e-6, 9e-6]))


def test_joints_come_in_any_order_under_other_names(tmp_path) -> None:
    t = np.arange(400) / 100.0
    swapped = [
        (at, joint_state(at, ["arm_elbow", "finger", "arm_lift"], [b, 0.0, a]))
        for at, (a, b) in zip(t, path(t), strict=True)
    ]
    bag = write_bag(tmp_path / "bag", {"/js": ("JointState", swapped), "/p": marker()}, mcap=True)
    read = read_bag(bag, JOINTS, BagTopics(names={"lift": "arm_lift", "elbow": "arm_elbow"}))
    assert read.q == pytest.approx(path(np.asarray(read.t) - BEGUN_S), abs=2e-5)


def test_late_stamps_are_taken_back(tmp_path) -> None:
    bag = write_bag(tmp_path / "bag", {"/js": states(), "/p": marker()}, mcap=True)
    read = read_bag(bag, JOINTS, BagTopics(delay_s=0.05))
    first = np.asarray(read.t)[0] - BEGUN_S
    assert first == pytest.approx(0.05)
    assert read.q[0] == pytest.approx(path(np.array([first]))[0], abs=1e-4)


def refused(bag: Path) -> str:
    with pytest.raises(RecordingError) as error:
        read_bag(bag, JOINTS, BagTopics())
    return str(error.value)


def test_several_markers_are_asked_about(tmp_path) -> None:
    bag = write_bag(tmp_path / "bag", {"/js": states(), "/a": marker(), "/b": marker("PoseStamped")}, mcap=True)
    told = refused(bag)
    assert "several topics have positions: /a, /b" in told
    assert "--marker-topic" in told


def test_frames_of_tf_are_listed(tmp_path) -> None:
    bag = write_bag(tmp_path / "bag", {"/js": states(), "/tf": marker("TFMessage")}, mcap=True)
    assert "There are tag_0 in camera. Give it with --marker-frame" in refused(bag)


def test_a_tag_that_comes_late_is_found(tmp_path) -> None:
    kind, tags = marker("TFMessage")
    hands = [(t, tf(t, np.ones(3), "base", "hand")) for t in np.arange(0, SECONDS, 0.005).tolist()]
    late = [(t, fix) for t, fix in tags if t > 2.0]
    messages = sorted(hands + late, key=lambda timed: timed[0])
    bag = write_bag(tmp_path / "bag", {"/js": states(), "/tf": (kind, messages)}, mcap=True)
    assert len(read_bag(bag, JOINTS, BagTopics(frame="tag_0"))) == len(late)


def test_missing_joints_are_named(tmp_path) -> None:
    bag = write_bag(tmp_path / "bag", {"/js": states(("lift", "wrist")), "/p": marker()}, mcap=True)
    assert "/js says nothing of elbow; it has lift, wrist" in refused(bag)


def test_a_bag_without_a_marker_lists_its_topics(tmp_path) -> None:
    bag = write_bag(tmp_path / "bag", {"/js": states()}, mcap=False)
    assert "The bag has /js (sensor_msgs/msg/JointState, 400)" in refused(bag)


def test_positions_in_two_frames_are_refused(tmp_path) -> None:
    kind, fixes = marker()
    bag = write_bag(tmp_path / "bag", {"/js": states(), "/p": (kind, fixes + marker(frame="other")[1])}, mcap=True)
    assert "in the frames camera, other" in refused(bag)


def test_truncated_bag_is_rejected(tmp_path) -> None:
    bag = write_bag(tmp_path / "bag", {"/js": states(), "/p": marker()}, mcap=True)
    file = next(bag.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:2000])
    assert "the bag cannot be read" in refused(bag)


@pytest.mark.parametrize("mcap", [True, False])
def test_named_pipe_in_a_bag_is_rejected(tmp_path, mcap) -> None:
    bag = write_bag(tmp_path / "bag", {"/js": states(), "/p": marker()}, mcap=mcap)
    (data,) = (file for file in bag.iterdir() if file.suffix != ".yaml")
    data.unlink()
    os.mkfifo(data)
    assert "a pipe, not a file" in refused(bag)
    assert "a pipe, not a file" in refused(data)


def test_a_long_description_of_a_bag_is_refused(tmp_path) -> None:
    bag = write_bag(tmp_path / "bag", {"/js": states(), "/p": marker()}, mcap=True)
    with (bag / "metadata.yaml").open("a") as stream:
        stream.write("x: [" + "1," * 600_000 + "]\n")
    assert "larger than 1 MiB" in refused(bag)


def test_chunk_unpacking_beyond_memory_is_rejected(tmp_path, monkeypatch) -> None:
    zstd = pytest.importorskip("backports.zstd")
    monkeypatch.setattr(recording_bag.FileLimits, "memory_bytes", 2**26)
    unpacked = 2**28

    def text(value: bytes) -> bytes:
        return struct.pack("<I", len(value)) + value

    def record(kind: int, content: bytes) -> bytes:
        return struct.pack("<BQ", kind, len(content)) + content

    packed = zstd.compress(bytes(unpacked))
    chunk = struct.pack("<QQQI", 0, 1, unpacked, 0) + text(b"zstd") + struct.pack("<Q", len(packed)) + packed
    magic = b"\x89MCAP0\r\n"
    records = (record(1, text(b"ros2") + text(b"")), record(6, chunk), record(15, bytes(4)), record(2, bytes(20)))
    (tmp_path / "a.mcap").write_bytes(magic + b"".join(records) + magic)
    assert "reading it takes more than" in refused(tmp_path / "a.mcap")
    assert len(bytes(unpacked)) == unpacked  # the limit has been taken back


def test_joints_too_fast_to_interpolate_are_left_out() -> None:
    t = np.arange(0, 10, 0.05)
    q = np.where(t < 5, 0.0, np.sin(40 * t))[:, None]
    at = np.arange(0.1, 9.9, 1 / 30)
    run = np.zeros(len(t), dtype=np.int64)
    fixes = MarkerTrack(at, np.zeros((len(at), 3)), np.zeros(len(at), dtype=np.int64))
    read = joined(("j",), JointTrack(t, q, run), fixes, Path("bag"))
    assert np.asarray(read.t).max() < 5.0


def test_disjoint_joint_and_marker_clocks_are_rejected() -> None:
    t, run = np.arange(0, 1, 0.01), np.zeros(100, dtype=np.int64)
    with pytest.raises(RecordingError, match=r"joints are from 0.000 to 0.990 s, the marker from 100.000"):
        joined(("j",), JointTrack(t, t[:, None], run), MarkerTrack(t + 100, np.zeros((100, 3)), run), Path("bag"))
