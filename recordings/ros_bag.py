"""Recordings from ROS bags: rosbag2 (MCAP, sqlite3) and ROS 1. Needs the extra `bags`."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.interfaces.errors import RecordingError
from bodyschema.robot.limited import FileLimits, bounded_memory, check_regular, read_at_most
from bodyschema.robot.suggest import did_you_mean

from .parquet_file import imported
from .recording import Recording
from .tracks import JointTrack, MarkerTrack, joined

log = logging.getLogger(__name__)

BAG_ENDINGS = (".db3", ".mcap", ".bag")
METADATA = "metadata.yaml"
JOINT_STATE = "sensor_msgs/msg/JointState"
TF = "tf2_msgs/msg/TFMessage"
IMAGE = "sensor_msgs/msg/CompressedImage"
# How positions are taken from a message, by its type: position, quaternion or None, covariance (6, 6) or None.
Taken = tuple[Any, Any, Any]
_MARKERS: Mapping[str, Callable[[Any], Taken]] = {
    "geometry_msgs/msg/PointStamped": lambda m: (m.point, None, None),
    "geometry_msgs/msg/PoseStamped": lambda m: (m.pose.position, m.pose.orientation, None),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: (
        m.pose.pose.position,
        m.pose.pose.orientation,
        m.pose.covariance,
    ),
    "geometry_msgs/msg/TransformStamped": lambda m: (m.transform.translation, m.transform.rotation, None),
}
_NANO = 1_000_000_000


class _Settings:
    # Of metadata.yaml, which is parsed at some 100 kB/s; a topic or a part of the bag takes 1 kB.
    max_metadata_bytes = 2**20
    max_said = 200  # characters of another library's message, which may quote the file
    first_messages = 200  # messages that are looked at to learn which joints or frames a topic has


@dataclass(frozen=True)
class BagTopics:
    """Topics and names to read from a bag; None if the bag leaves no choice."""

    joints: str | None = None  # topic of the joint states
    marker: str | None = None  # topic of the marker's positions
    frame: str | None = None  # the marker's frame, where it comes by TF
    names: Mapping[str, str] = field(default_factory=dict)  # the joints' names in the bag, where they differ
    delay_s: float = 0.0  # delay of the timestamps of the marker's positions [s]


def is_bag(source: Path) -> bool:
    """Return True if `source` looks like a bag: a folder with metadata.yaml, or a file with a bag's suffix."""
    return (source / METADATA).is_file() or source.suffix.lower() in BAG_ENDINGS


def read_bag(source: Path, joints: tuple[str, ...], topics: BagTopics, marker: MarkerTrack | None = None) -> Recording:
    """Read joint states and positions of the marker, with the joints interpolated to the marker's times.

    Args:
        marker: positions from elsewhere, instead of the bag's.

    Raises:
        RecordingError: rosbags is not installed, the bag cannot be read, or its topics are ambiguous.
    """
    with _opened(source) as bag:
        joint_topic = _joint_topic(bag, joints, topics)
        found = _joint_track(bag, joint_topic, [topics.names.get(joint, joint) for joint in joints])
        if marker is None:
            marker = _marker_track(bag, _marker_topic(bag, topics), topics.frame)
    return joined(joints, found, marker.earlier(topics.delay_s), source)


def read_images(source: Path, topic: str) -> Iterator[tuple[float, bytes]]:
    """Yield the times of compressed images [s], and the images as JPEG or PNG files.

    Raises:
        RecordingError: rosbags is not installed, the bag cannot be read, or it has no such topic.
    """
    with _opened(source) as bag:
        topics = [each for each, kind in bag.types.items() if kind == IMAGE]
        for received, message in bag.messages(_require_topic(bag, topic, topics, "--video", IMAGE)):
            yield _stamp(message.header, received), message.data.tobytes()


@dataclass(frozen=True)
class _Bag:
    source: Path
    reader: Any

    @property
    def types(self) -> dict[str, str]:
        return {connection.topic: connection.msgtype for connection in self.reader.connections}

    @property
    def counts(self) -> Counter[str]:
        counts: Counter[str] = Counter()
        for connection in self.reader.connections:
            counts[connection.topic] += connection.msgcount
        return counts

    def messages(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Yield all messages of a topic with the time at which they were received [s]."""
        connections = [c for c in self.reader.connections if c.topic == topic]
        for connection, received_ns, data in self.reader.messages(connections=connections):
            yield received_ns / _NANO, self.reader.deserialize(data, connection.msgtype)

    def first_messages(self, topic: str) -> Iterator[Any]:
        for _, (_, message) in zip(range(_Settings.first_messages), self.messages(topic), strict=False):
            yield message

    def error(self, what: str, remedy: str) -> RecordingError:
        counts = self.counts
        listed = ", ".join(f"{topic} ({kind}, {counts[topic]})" for topic, kind in sorted(self.types.items()))
        ended = remedy if remedy.endswith(("?", ".")) else f"{remedy}."
        return RecordingError(what, file=self.source, remedy=f"{ended} The bag has {listed or 'no topics'}")


@contextmanager
def _opened(source: Path) -> Iterator[_Bag]:
    highlevel, typesys = (imported(f"rosbags.{name}", "bags", "a ROS bag", source) for name in ("highlevel", "typesys"))
    if not source.exists():
        raise RecordingError("there is no such file", file=source, remedy="Name a bag that is there")
    try:
        _check_files(source)
        store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
        with bounded_memory(FileLimits.memory_bytes), highlevel.AnyReader([source], default_typestore=store) as reader:
            yield _Bag(source, reader)
    except RecordingError:
        raise
    except MemoryError as error:
        what = f"reading it takes more than {FileLimits.memory_bytes // 2**30} GiB of memory"
        remedy = "Record the topics of joints and marker alone, or cut the bag: `ros2 bag convert`"
        raise RecordingError(what, file=source, remedy=remedy) from error
    except Exception as error:  # for damaged bytes rosbags may raise anything
        message = (str(error).strip() or type(error).__name__).split("\n")[0][: _Settings.max_said].rstrip(".")
        remedy = "A bag whose recording was cut off: `ros2 bag reindex`; one of splits: name the folder"
        raise RecordingError(f"the bag cannot be read: {message}", file=source, remedy=remedy) from error


def _check_files(source: Path) -> None:
    """Raise OSError if a file of the bag is a device or a pipe, or its description is longer than plausible."""
    if not source.is_dir():
        check_regular(source)
        return
    read_at_most(source / METADATA, _Settings.max_metadata_bytes)
    for file in source.iterdir():
        if not file.is_dir():
            check_regular(file)


def _joint_topic(bag: _Bag, joints: Sequence[str], topics: BagTopics) -> str:
    required = {topics.names.get(joint, joint) for joint in joints}
    known = [topic for topic, kind in bag.types.items() if kind == JOINT_STATE]
    if topics.joints is not None:
        known = [_require_topic(bag, topics.joints, known, "--joint-topic", JOINT_STATE)]
    if not known:
        raise bag.error(f"there is no topic of {JOINT_STATE}", "Record the topic with the robot's joints.")
    names_in = {topic: {name for message in bag.first_messages(topic) for name in message.name} for topic in known}
    complete = [topic for topic in known if required <= names_in[topic]]
    if len(complete) > 1:
        raise bag.error(
            f"several topics have the joints: {', '.join(complete)}", "Give one of them with --joint-topic."
        )
    if not complete:
        best = max(known, key=lambda topic: len(required & names_in[topic]))
        missing = sorted(required - names_in[best])
        raise RecordingError(
            f"{best} says nothing of {', '.join(missing)}; it has {', '.join(sorted(names_in[best])) or 'no joints'}",
            file=bag.source,
            remedy="Correct [robot] joints, or name them in [drivers.ros2.names] of robot.toml",
        )
    return complete[0]


def _marker_topic(bag: _Bag, topics: BagTopics) -> str:
    kinds = bag.types
    known = [topic for topic, kind in kinds.items() if kind in _MARKERS]
    tf = [topic for topic, kind in kinds.items() if kind == TF and bag.counts[topic]]
    if topics.marker is not None:
        topic = _require_topic(bag, topics.marker, [*known, *tf], "--marker-topic", "positions")
        known, tf = [topic] if topic in known else [], [topic] if topic in tf else []
    if topics.frame is not None:
        seen = {topic: _frames(bag, topic, topics.frame) for topic in tf}
        leading = [topic for topic in tf if any(child == topics.frame for _, child in seen[topic])]
        if leading:
            return min(leading, key=lambda topic: topic.endswith("static"))
        frames = sorted({child for pairs in seen.values() for _, child in pairs})
        raise bag.error(
            f"no transform leads to the frame {topics.frame!r}; there are {', '.join(frames) or 'none'}",
            f"Correct --marker-frame. {did_you_mean(topics.frame, frames)}" if frames else "Record /tf.",
        )
    if len(known) == 1:
        return known[0]
    if known:
        raise bag.error(f"several topics have positions: {', '.join(known)}", "Give the marker's with --marker-topic.")
    if tf:
        pairs = sorted({pair for topic in tf for pair in _frames(bag, topic)})
        listed = ", ".join(f"{child} in {parent}" for parent, child in pairs)
        raise RecordingError(
            f"which frame of TF is the marker? There are {listed}",
            file=bag.source,
            remedy="Give it with --marker-frame; its parent has to be the camera's frame",
        )
    raise bag.error(
        "there is no topic with positions of a marker",
        "Record PointStamped, PoseStamped, TransformStamped or TF of it; or give --markers FILE.csv, or --video and "
        "the topic of its camera's compressed images.",
    )


def _frames(bag: _Bag, topic: str, child_frame: str | None = None) -> set[tuple[str, str]]:
    """Return parent and child of the transforms on a topic, of all messages or until the child `child_frame` comes."""
    found: set[tuple[str, str]] = set()
    for _, message in bag.messages(topic):
        found |= {(transform.header.frame_id, _child(transform)) for transform in message.transforms}
        if any(child == child_frame for _, child in found):
            break
    return found


def _require_topic(bag: _Bag, topic: str, known: Sequence[str], option: str, what: str) -> str:
    if topic not in known:
        raise bag.error(f"{option} {topic}: there is no such topic of {what}", did_you_mean(topic, known or [topic]))
    return topic


def _joint_track(bag: _Bag, topic: str, names: Sequence[str]) -> JointTrack:
    """Read all messages that have every joint; indices of the names are looked up once for each order of them."""
    t: list[float] = []
    q: list[list[float]] = []
    places: dict[tuple[str, ...], list[int] | None] = {}
    left_out = 0
    for received, message in bag.messages(topic):
        order = tuple(message.name)
        if order not in places:
            places[order] = [order.index(name) for name in names] if set(names) <= set(order) else None
        at = places[order]
        if at is None or len(message.position) < len(order):
            left_out += 1
            continue
        t.append(_stamp(message.header, received))
        q.append(message.position[at])
    if not t:
        raise RecordingError(
            f"no message of {topic} has positions of all joints", file=bag.source, remedy="Give another --joint-topic"
        )
    if left_out:
        log.warning("%s: %d messages of %s lack joints or positions, and are left out", bag.source, left_out, topic)
    values = np.array(q)
    finite = np.isfinite(values).all(axis=1)
    return JointTrack(np.array(t)[finite], values[finite], np.zeros(int(finite.sum()), dtype=np.int64))


def _marker_track(bag: _Bag, topic: str, frame: str | None) -> MarkerTrack:
    rows: list[tuple[float, ...]] = []
    covariances: list[Any] = []
    parents: Counter[str] = Counter()
    for stamp, parent, (place, turn, cov) in _fixes(bag, topic, frame):
        parents[parent] += 1
        quaternion = (turn.x, turn.y, turn.z, turn.w) if turn is not None else (0.0, 0.0, 0.0, 0.0)
        rows.append((stamp, place.x, place.y, place.z, *quaternion))
        covariances.append(None if cov is None else cov)
    if len(parents) != 1:
        what = (
            f"positions on {topic} are in the frames {', '.join(parents)}" if parents else f"{topic} has no positions"
        )
        raise RecordingError(what, file=bag.source, remedy="All have to be in one frame, the camera's")
    log.info("%s: %d positions of %s in the frame %s", bag.source, len(rows), topic, next(iter(parents)))
    table = np.array(rows)
    finite = np.asarray(np.isfinite(table).all(axis=1))
    table = table[finite]
    turns = table[:, 4:]
    lengths = np.linalg.norm(turns, axis=1)
    # A tracker of a ball sends a constant rotation; no arm keeps its hand at a constant orientation.
    turned = bool((np.abs(lengths - 1.0) < 1e-3).all() and np.ptp(turns, axis=0).max() > 0)
    return MarkerTrack(
        t=table[:, 0],
        x=table[:, 1:4],
        run=np.zeros(len(table), dtype=np.int64),
        cov=_covariances(covariances, finite),
        orientation=turns / lengths[:, None] if turned else None,
    )


def _fixes(bag: _Bag, topic: str, frame: str | None) -> Iterator[tuple[float, str, Taken]]:
    kind = bag.types[topic]
    for received, message in bag.messages(topic):
        if kind != TF:
            yield _stamp(message.header, received), message.header.frame_id, _MARKERS[kind](message)
            continue
        for each in message.transforms:
            if frame is None or _child(each) == frame:
                taken = (each.transform.translation, each.transform.rotation, None)
                yield _stamp(each.header, received), each.header.frame_id, taken


def _covariances(found: Sequence[Any], finite: np.ndarray) -> np.ndarray | None:
    """Return the positions' covariances (m, 3, 3) if all messages have a nonzero one."""
    if any(cov is None for cov in found):
        return None
    whole = np.array(found, dtype=np.float64).reshape(-1, 6, 6)[finite, :3, :3]
    whole = (whole + np.swapaxes(whole, 1, 2)) / 2.0
    return whole if (np.linalg.eigvalsh(whole)[:, 0] > 0).all() else None


def _child(transform: Any) -> str:
    return transform.child_frame_id.lstrip("/")


def _stamp(header: Any, received: float) -> float:
    """Return the time of a header [s], or that of the bag if the header has none."""
    return header.stamp.sec + header.stamp.nanosec / _NANO if header.stamp.sec or header.stamp.nanosec else received
