"""Findings of `bodyschema doctor` about a ROS 2 robot, in virtual time."""

from __future__ import annotations

import pytest
from ros2_robot import PATHS, Robot
from spoilt_messages import Fault

from bodyschema.drivers.checks import Check
from bodyschema.drivers.ros2.config import Ros2Config
from bodyschema.drivers.ros2.emulator.node import Node
from bodyschema.drivers.ros2.joints import joint_state_checks
from bodyschema.interfaces.errors import SourceLost

JOINTS = ("elbow", "pan", "lift")


def checks_of(robot: Robot, joints: tuple[str, ...] = JOINTS) -> dict[str, Check]:
    told = joint_state_checks(Ros2Config(), joints, robot.clock, open_link=lambda *_: robot.link)
    return {check.subject: check for check in told}


def test_healthy_robot_is_ok_with_its_rate() -> None:
    told = checks_of(Robot())
    assert {check.state for check in told.values()} == {"ok"}
    assert told["rate"].said in {"99 readings/s come", "100 readings/s come"}
    assert told["errors"].said.startswith("0 of ")


def test_unpublished_joint_is_wrong_and_fix_maps_names() -> None:
    told = checks_of(Robot(), ("elbow", "pan", "wrist"))
    assert told["joint states"].state == "wrong"
    assert "does not name wrist" in told["joint states"].said
    assert told["joint states"].fix == "Say in [drivers.ros2] names what ROS calls each joint"


def test_silent_robot_is_wrong_within_three_seconds() -> None:
    robot = Robot([])
    begin = robot.clock.now()
    assert checks_of(robot)["joint states"].state == "wrong"
    assert robot.clock.now() - begin < 3.0


def test_missing_router_is_wrong_and_fix_starts_it() -> None:
    def refuse(*_: object) -> None:
        raise SourceLost("no zenoh router answers on tcp/h:7447. Start it on the robot: ros2 run ...", retry_s=1.0)

    told = list(joint_state_checks(Ros2Config(), JOINTS, Robot().clock, open_link=refuse))
    assert told == [
        Check("router", "wrong", "no zenoh router answers on tcp/h:7447", "Start it on the robot: ros2 run ...")
    ]


@pytest.mark.parametrize(
    ("robot", "subject"),
    [(Robot([Node(PATHS, 10.0)]), "rate"), (Robot(share=0.1, kinds=(Fault.TRUNCATED,), seed=1), "errors")],
)
def test_few_readings_and_many_errors_are_warnings(robot, subject) -> None:
    assert checks_of(robot)[subject].state == "warning"
