"""The table [drivers.ros2] of robot.toml."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.suggest import did_you_mean
from bodyschema.robot.toml_file import ENDPOINT, Positive, line_of

TABLE = ("drivers", "ros2")
TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


class MarkerTopic(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [drivers.ros2.marker]: the topic where the learner publishes the predicted marker position."""

    frame: str  # name of the measurement frame in ROS, in which the positions are given
    topic: str = "/bodyschema/marker"  # name of the topic
    # `point` is geometry_msgs/PointStamped, `pose` geometry_msgs/PoseWithCovarianceStamped
    message: Literal["point", "pose"] = "point"


class Ros2Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [drivers.ros2]."""

    router: str = "tcp/127.0.0.1:7447"  # where rmw_zenohd, or the zenoh bridge, listens
    via: Literal["rmw_zenoh", "ros2dds"] = "rmw_zenoh"  # rmw_zenoh, or zenoh-bridge-ros2dds for robots on DDS
    domain: Annotated[int, Meta(ge=0, le=232)] = 0  # ROS_DOMAIN_ID of the robot, for rmw_zenoh
    topic: str = "/joint_states"  # the joint states
    # the name of a joint in ROS, by its name in [robot] joints; joints left out have the same name
    names: dict[str, str] = {}
    max_delay_s: Positive = 0.1  # a message is rejected if it arrives this much later than the fastest one
    marker: MarkerTopic | None = None  # publish predictions

    def ros_names(self, joints: Sequence[str]) -> tuple[str, ...]:
        """Return the names of `joints` in ROS."""
        return tuple(self.names.get(joint, joint) for joint in joints)

    def check(self, joints: Sequence[str], file: Path, text: str) -> None:
        """Raise ConfigError for a name that is not one of `joints`, given twice, or invalid."""
        for keys, what, remedy in self._mistakes(joints):
            raise ConfigError(what, file=file, line=line_of(text, (*TABLE, *keys)), remedy=remedy)

    def _mistakes(self, joints: Sequence[str]) -> Iterator[tuple[tuple[str, ...], str, str]]:
        if not ENDPOINT.fullmatch(self.router):
            yield ("router",), f"drivers.ros2.router: {self.router!r} is no endpoint", "Write tcp/127.0.0.1:7447"
        if not TOPIC.fullmatch(self.topic):
            yield ("topic",), f"{self.topic!r} is no name of a topic", "Write one as `ros2 topic list` does"
        if self.marker is not None and not TOPIC.fullmatch(self.marker.topic):
            yield ("marker", "topic"), f"{self.marker.topic!r} is no name of a topic", "Write /bodyschema/marker"
        if self.marker is not None and self.via == "ros2dds":
            yield ("marker",), "predictions are published for rmw_zenoh alone", "Take the table out"
        for joint in self.names:
            if joint not in joints:
                yield ("names", joint), f"unknown joint {joint!r}", did_you_mean(joint, joints)
        given = self.ros_names(joints)
        for name in given:
            if given.count(name) > 1:
                yield ("names",), f"two joints have the name {name!r} in ROS", "Give each its own"
