"""Publishes corrected joint states beside the raw ones of a ROS 2 robot whose nodes use rmw_zenoh.

python ros2_node.py correction.json [--router tcp/127.0.0.1:7447] [--domain 0] [--topic /joint_states]

It publishes sensor_msgs/JointState on /joint_states_corrected, which `ros2 topic echo` shows, and for programs without
ROS {"t_ns": …, "q": […], "marker": {…}} as JSON on bodyschema/<robot>/corrected, the marker's pose in SI as matrix,
quaternion and 6 x 6 covariance. Where the covariance is null, `covariance_unknown` says why. A message that does not
have all joints, or a position that is not finite, is passed over. Velocities and efforts stay as they are. What depends
on moves between rows of a recording (settling) is left out: messages come at another pace.
"""

import argparse
import hashlib
import json
import time

import msgspec
import numpy as np
import zenoh
from correction import Correction

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.cdr import Malformed
from bodyschema.drivers.ros2.link import open_session
from bodyschema.drivers.ros2.messages import JOINT_STATE, JointState, decode_joint_state, encode_joint_state
from bodyschema.robot.calibrated_files import CAMERA_LINK, MARKER_LINK
from bodyschema.robot.hand_eye import HandEye

NODE = "bodyschema_correction"
UNKNOWN = (
    "correction.json has none: export it from an extended.toml in which something was fitted, beside its diagnosis.json"
)


class CorrectedJoints:
    """A node that listens to joint states and publishes corrected ones."""

    def __init__(self, session, file, domain, topic):
        contents = json.loads(file)
        self.arm, self.names = Correction(file), contents["joints"]
        known = contents.get("pose_covariance")
        self.covariance = None if known is None else np.reshape(known, (6, 6))
        self.session, self.sequence = session, 0
        corrected, name = f"{topic}_corrected", str(session.info.zid())
        tokens = rmw.node_token(domain, name, NODE), rmw.publisher_token(domain, name, NODE, corrected, JOINT_STATE)
        self.tokens = [session.liveliness().declare_token(token) for token in tokens]
        self.gid = hashlib.blake2b(tokens[1].encode(), digest_size=rmw.GID_BYTES).digest()
        self.to_ros = session.declare_publisher(rmw.topic_key(domain, corrected, JOINT_STATE))
        self.to_zenoh = session.declare_publisher(f"bodyschema/{contents['robot']}/corrected")
        # Messages of whatever ROS 2 version: the type is given, its hash is not.
        key = rmw.topic_key(domain, topic, JOINT_STATE, rmw.ANY)
        self.raw = session.declare_subscriber(key, self.take)

    def take(self, sample):
        """Publish what a message becomes."""
        try:
            message = decode_joint_state(sample.payload.to_bytes())
            places = [message.names.index(name) for name in self.names]
            readings = [message.positions[place] for place in places]
            if not np.isfinite(readings).all():
                return
            angles, pose = self.arm.read(readings, pace=-1.0)
        except (Malformed, ValueError, IndexError):
            return
        positions = list(message.positions)
        for place, angle in zip(places, angles, strict=True):
            positions[place] = angle
        corrected = JointState(message.header, message.names, tuple(positions), message.velocities, message.efforts)
        self.sequence += 1
        attached = rmw.attachment(self.sequence, time.time_ns(), self.gid)
        self.to_ros.put(encode_joint_state(corrected), attachment=attached)
        T = np.array([*pose, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)
        marker = msgspec.to_builtins(HandEye.of(CAMERA_LINK, MARKER_LINK, T, self.covariance))
        if self.covariance is None:
            marker["covariance_unknown"] = UNKNOWN
        self.to_zenoh.put(json.dumps({"t_ns": message.header.stamp_ns, "q": angles, "marker": marker}))


def main():
    """Correct until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file")
    parser.add_argument("--router", default="tcp/127.0.0.1:7447")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--topic", default="/joint_states")
    asked = parser.parse_args()
    with open(asked.file, encoding="utf-8") as stream, open_session(asked.router) as session:
        node = CorrectedJoints(session, stream.read(), asked.domain, asked.topic)
        print(f"{asked.topic} -> {asked.topic}_corrected for {', '.join(node.names)}; Ctrl-C ends")
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            pass


if __name__ == "__main__":
    zenoh.init_log_from_env_or("error")
    main()
