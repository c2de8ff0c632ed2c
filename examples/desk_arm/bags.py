"""Write my_bag and new_bag: ROS 2 bags of a simulated desk arm, to try docs/ros2_bag.md with.

Joint states come at 100 Hz, and a ball's positions at 30 Hz from a camera with 0.5 mm of noise. The links are built to
0.1° and 0.5 mm, shoulder_pitch and elbow_pitch are off by 2° and -1.5°, and the ball sits centimetres off. Needs the
extra `bags`.
"""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from bodyschema.robot.description import RobotDescription
from kbmaps import ChainParameters, ChainTolerances

STORE = get_typestore(Stores.ROS2_HUMBLE)
BEGUN_S, NOISE_M, OFFSETS_DEG = 1_700_000_000, 5e-4, (0.0, 2.0, -1.5, 0.0)
SPEEDS = np.array([0.31, 0.47, 0.61, 0.83])
CAMERA = "left_camera_optical_frame"
rng = np.random.default_rng(1)
robot = RobotDescription.load(Path(__file__).with_name("robot.toml"))
parameters = ChainParameters(robot.chain)
built = parameters.standard_deviations(ChainTolerances(0.002, 0.0005, tool=0.03)) * rng.normal(size=parameters.size)
built[parameters.zeros] = np.radians(OFFSETS_DEG)


def made(kind, *values):
    """Return a ROS message."""
    return STORE.types[kind.replace("/", "/msg/")](*values)


def header(t, frame):
    """Return the header of a message at a time [s] from the beginning."""
    ns = round(t * 1e9)
    return made("std_msgs/Header", made("builtin_interfaces/Time", BEGUN_S + ns // 10**9, ns % 10**9), frame)


def path(t, phases):
    """Return joint angles (n, d) at times (n,)."""
    slow, fast = np.sin(np.outer(t, 0.3 * SPEEDS) + phases[0]), np.sin(np.outer(t, SPEEDS) + phases[1])
    return 0.4 * robot.upper * (slow + fast)


def write(folder, seconds, plugin):
    """Write a bag of a path of its own."""
    phases = rng.uniform(0, 2 * np.pi, (2, len(robot.joints)))
    seen = np.arange(0.1, seconds - 0.1, 1 / 30) + 0.003
    x = parameters.positions(built, path(seen, phases)) + NOISE_M * rng.normal(size=(len(seen), 3))
    read = np.arange(round(100.0 * seconds)) / 100.0
    names, none = [*robot.joints, "finger"], np.array([])
    turn = made("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
    topics = {
        "/joint_states": [
            (t, made("sensor_msgs/JointState", header(t, ""), names, np.append(q, 0.0), none, none))
            for t, q in zip(read.tolist(), path(read, phases), strict=True)
        ],
        "/ball": [
            (t, made("geometry_msgs/PointStamped", header(t, CAMERA), made("geometry_msgs/Point", *each)))
            for t, each in zip(seen.tolist(), x.tolist(), strict=True)
        ],
        "/goal_pose": [  # what a robot was asked for is no measurement
            (t, made("geometry_msgs/PoseStamped", header(t, "base_link"), made("geometry_msgs/Pose", point, turn)))
            for t, point in [(t, made("geometry_msgs/Point", 1.0, 1.0, 1.0)) for t in (1.0, 2.0)]
        ],
    }
    with Writer(Path(folder), version=9, storage_plugin=plugin) as writer:
        for topic, messages in topics.items():
            kind = messages[0][1].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for t, message in messages:
                writer.write(connection, round((BEGUN_S + t) * 1e9), STORE.serialize_cdr(message, kind))


write("my_bag", 60.0, StoragePlugin.MCAP)
write("new_bag", 30.0, StoragePlugin.SQLITE3)
