"""CPU time and memory of importing a ten-minute ROS bag: `python -m benchmarks.bag_import`."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from bodyschema.recordings.ros_bag import BagTopics, read_bag

JOINTS = tuple(f"joint_{k}" for k in range(1, 7))
SECONDS, JOINTS_HZ, POSES_HZ = 600, 100, 30
BEGUN_S = 1_700_000_000


def main() -> None:
    """Write a bag of each kind, and read it in a separate process."""
    if len(sys.argv) > 1:
        _read(Path(sys.argv[1]))
        return
    with tempfile.TemporaryDirectory() as folder:
        for plugin in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
            bag = Path(folder) / plugin.name.lower()
            _write(bag, plugin)
            subprocess.run([sys.executable, "-m", "benchmarks.bag_import", str(bag)], check=True)


def _read(bag: Path) -> None:
    begun = time.process_time()
    rows = len(read_bag(bag, JOINTS, BagTopics()))
    seconds, peak_mb = time.process_time() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{bag.name}: {rows} rows in {seconds:.1f} s of CPU, {peak_mb:.0f} MB at most")


def _write(bag: Path, plugin: StoragePlugin) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    types, empty = store.types, np.array([])
    state, pose = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped"

    def header(t: float) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](BEGUN_S + int(t), int(t % 1 * 1e9))
        return types["std_msgs/msg/Header"](stamp, "camera")

    with Writer(bag, version=9, storage_plugin=plugin) as writer:
        joints, tag = (
            writer.add_connection(topic, kind, typestore=store)
            for topic, kind in (("/joint_states", state), ("/tag", pose))
        )
        for t in np.arange(SECONDS * JOINTS_HZ) / JOINTS_HZ:
            message = types[state](header(t), list(JOINTS), np.sin(t * np.linspace(0.3, 0.8, 6)), empty, empty)
            writer.write(joints, round((BEGUN_S + t) * 1e9), store.serialize_cdr(message, state))
        for t in np.arange(SECONDS * POSES_HZ) / POSES_HZ:
            place = types["geometry_msgs/msg/Point"](float(np.sin(t)), float(np.cos(t)), 1.0)
            turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
            message = types[pose](header(t), types["geometry_msgs/msg/Pose"](place, turn))
            writer.write(tag, round((BEGUN_S + t) * 1e9), store.serialize_cdr(message, pose))


if __name__ == "__main__":
    main()
