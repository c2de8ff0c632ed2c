"""ROS bags written by rosbags itself: joint states and a tracker's marker positions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
T = STORE.types
BEGUN_S = 1_700_000_000
_NAMES = {
    kind: f"{package}/msg/{kind}"
    for package, kinds in {
        "sensor_msgs": ["CompressedImage", "JointState"],
        "geometry_msgs": [
            "Point", "PointStamped", "Pose", "PoseStamped", "PoseWithCovariance", "PoseWithCovarianceStamped",
            "Quaternion", "Transform", "TransformStamped", "Vector3",
        ],
        "tf2_msgs": ["TFMessage"],
        "std_msgs": ["Header"],
        "builtin_interfaces": ["Time"],
    }.items()
    for kind in kinds
}  # fmt: skip


def made(kind: str, *values: Any, **fields: Any) -> Any:
    return T[_NAMES[kind]](*values, **fields)


def header(t: float, frame: str) -> Any:
    ns = round(t * 1e9)
    return made("Header", made("Time", BEGUN_S + ns // 1_000_000_000, ns % 1_000_000_000), frame)


def joint_state(t: float, names: Sequence[str], q: np.ndarray) -> Any:
    empty = np.array([])
    return made("JointState", header(t, ""), list(names), np.asarray(q, dtype=np.float64), empty, empty)


def quaternion(turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Any:
    return made("Quaternion", *map(float, turn))


def point_stamped(t: float, x: np.ndarray, frame: str = "camera") -> Any:
    return made("PointStamped", header(t, frame), made("Point", *map(float, x)))


def pose_stamped(t: float, x: np.ndarray, frame: str = "camera") -> Any:
    return made("PoseStamped", header(t, frame), made("Pose", made("Point", *map(float, x)), quaternion()))


def compressed_image(t: float, file: bytes) -> Any:
    return made("CompressedImage", header(t, "camera"), "jpeg", np.frombuffer(file, np.uint8))


def pose_with_covariance(t: float, x: np.ndarray, frame: str = "camera") -> Any:
    pose = made("Pose", made("Point", *map(float, x)), quaternion())
    cov = np.diag([1e-6, 1e-6, 9e-6, 1.0, 1.0, 1.0]).ravel()
    return made("PoseWithCovarianceStamped", header(t, frame), made("PoseWithCovariance", pose, cov))


def tf(t: float, x: np.ndarray, frame: str = "camera", child: str = "tag_0") -> Any:
    transform = made("Transform", made("Vector3", *map(float, x)), quaternion())
    return made("TFMessage", [made("TransformStamped", header(t, frame), child, transform)])


def write_bag(folder: Path, topics: Mapping[str, tuple[str, Sequence[tuple[float, Any]]]], *, mcap: bool) -> Path:
    """Write messages (time, message) by topic, each topic with its kind of message."""
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        for topic, (kind, messages) in topics.items():
            connection = writer.add_connection(topic, _NAMES[kind], typestore=STORE)
            for t, message in messages:
                ns = round((BEGUN_S + t) * 1e9)
                writer.write(connection, ns, STORE.serialize_cdr(message, _NAMES[kind]))
    return folder


def joint_topic(
    names: Sequence[str], path: Callable[[np.ndarray], np.ndarray], *, rate_hz: float, seconds: float
) -> tuple[str, list[tuple[float, Any]]]:
    """Return the joint states of a path, which gives (n, d) angles at times (n,)."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    return "JointState", [(at, joint_state(at, names, q)) for at, q in zip(t.tolist(), path(t), strict=True)]
