"""Publishes a calibrated camera's pose on /tf_static of a ROS 2 robot whose nodes use rmw_zenoh, without ROS.

bodyschema calibrate my_bag --json > calibration.json
python tf_static.py calibration.json [--router tcp/127.0.0.1:7447] [--domain 0]

It takes `hand_eye` of `calibrate --json` and of diagnosis.json, and `right_camera` of `calibrate cameras --json`.
Nodes that start later get the pose, too.
"""

import argparse
import hashlib
import json
import time

import zenoh
import zenoh.ext

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.link import open_session
from bodyschema.drivers.ros2.messages import TF_MESSAGE, Header, encode_transform

NODE, TOPIC, AGAIN_S = "bodyschema_tf_static", "/tf_static", 5.0


class StaticTransform:
    """A node that publishes one pose, as `HandEye` has it."""

    def __init__(self, session, pose, domain):
        self.pose, self.sequence, name = pose, 0, str(session.info.zid())
        told = rmw.publisher_token(domain, name, NODE, TOPIC, TF_MESSAGE, rmw.LATCHED_QOS)
        tokens = rmw.node_token(domain, name, NODE), told
        self.tokens = [session.liveliness().declare_token(token) for token in tokens]
        self.gid = hashlib.blake2b(told.encode(), digest_size=rmw.GID_BYTES).digest()
        self.publisher = zenoh.ext.declare_advanced_publisher(
            session, rmw.topic_key(domain, TOPIC, TF_MESSAGE), cache=zenoh.ext.CacheConfig(1), publisher_detection=True
        )

    def publish(self):
        """Publish the pose."""
        self.sequence += 1
        pose, header = self.pose, Header(time.time_ns(), self.pose["parent"])
        payload = encode_transform(header, pose["child"], pose["translation_m"], pose["quaternion_xyzw"])
        self.publisher.put(payload, attachment=rmw.attachment(self.sequence, time.time_ns(), self.gid))


def main():
    """Publish until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file")
    parser.add_argument("--router", default="tcp/127.0.0.1:7447")
    parser.add_argument("--domain", type=int, default=0)
    asked = parser.parse_args()
    with open(asked.file, encoding="utf-8") as stream:
        told = json.load(stream)
    pose = told.get("hand_eye") or told.get("right_camera")
    if pose is None:
        parser.error(f"{asked.file} has neither hand_eye nor right_camera")
    with open_session(asked.router) as session:
        node = StaticTransform(session, pose, asked.domain)
        print(f"{pose['child']} in {pose['parent']} on {TOPIC}; Ctrl-C ends")
        try:
            while True:
                node.publish()
                time.sleep(AGAIN_S)
        except KeyboardInterrupt:
            pass


if __name__ == "__main__":
    zenoh.init_log_from_env_or("error")
    main()
