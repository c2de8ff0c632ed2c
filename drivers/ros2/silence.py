"""Explain why a robot's joint states are missing, and what to do about it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence

from . import rmw
from .config import Ros2Config
from .messages import JOINT_STATE
from .senders import Refusal

SHOWN = 12

ADVICE = {
    Refusal.MALFORMED: "it is no intact sensor_msgs/JointState; see what publishes it: ros2 topic info -v",
    Refusal.NO_POSITIONS: "it has names and no positions; take a topic that has them",
    Refusal.TWICE: "it names a joint twice; fix the node that publishes it",
    Refusal.NOT_FINITE: "a position is not finite; the robot does not know where that joint is",
    Refusal.NO_STAMP: "its stamp is zero; the node that publishes it has to fill in header.stamp",
    Refusal.DUPLICATE: "its stamp is that of the message before; the positions are not newer than its stamp",
    Refusal.OUT_OF_ORDER: "its stamp is earlier than that of the message before; two nodes may share one publisher",
    Refusal.DELAYED: "it came much later than others; fix the network, or set max_delay_s",
    Refusal.TOO_FAST: "a joint cannot have come there so fast; fix names, or set max_speed_deg_s",
    Refusal.RIVAL: "two nodes publish the same joint; end one, joint_state_publisher for example",
    Refusal.GAP: "the joints come in several messages, too far apart in time; publish faster, or set max_gap_s",
}


def silence(
    config: Ros2Config,
    missing: Sequence[str],
    names: Collection[str],
    refused: Counter[Refusal],
    tokens: Callable[[], Sequence[str]],
) -> str:
    """Explain in one sentence why there are no readings.

    Args:
        config: of the robot.
        missing: joints, by their names in ROS, without any message.
        names: all joint names received.
        refused: number of unused messages, by reason.
        tokens: returns the tokens of existing publishers.
    """
    if refused:
        why, count = refused.most_common(1)[0]
        return f"nothing of {config.topic} can be used; {count} times: {ADVICE[why]}"
    if names and missing:
        there = ", ".join(sorted(names)[:SHOWN])
        return (
            f"{config.topic} says nothing about {', '.join(missing)}; it tells of {there}. "
            "Say in [drivers.ros2] names what ROS calls each joint"
        )
    if names:
        return f"{config.topic} has fallen silent; see whether the robot publishes: ros2 topic hz {config.topic}"
    return _unheard(config, list(rmw.topics_in(list(tokens()))))


def _unheard(config: Ros2Config, topics: Sequence[rmw.Topic]) -> str:
    wanted = "/" + config.topic.strip("/")
    here = [topic for topic in topics if topic.domain == config.domain]
    other_types = {topic.type for topic in here if topic.name == wanted} - {JOINT_STATE.name}
    if other_types:
        return f"{wanted} is no topic of sensor_msgs/JointState but of {', '.join(sorted(other_types))}; fix topic"
    if any(topic.name == wanted for topic in here):
        return f"a node publishes {wanted}, but says nothing; see whether the robot runs: ros2 topic hz {wanted}"
    elsewhere = sorted({topic.domain for topic in topics if topic.name == wanted})
    if elsewhere:
        return f"{wanted} is published in the domain {elsewhere[0]}, not {config.domain}; fix domain"
    others = sorted({topic.name for topic in here if topic.type == JOINT_STATE.name})[:SHOWN]
    if others:
        return f"nothing publishes {wanted}; there are joint states on {', '.join(others)}. Fix topic"
    return (
        f"nothing publishes {wanted} at the router {config.router}; start the robot with "
        "RMW_IMPLEMENTATION=rmw_zenoh_cpp, and its nodes with the same router"
    )
