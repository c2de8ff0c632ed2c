"""The expected marker position on a topic."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from scripted_sources import Scripted
from small_arm import write_small_arm

from bodyschema.daemon.config import Config
from bodyschema.daemon.learner.answers import ExpectedMarker
from bodyschema.daemon.wiring.wiring import open_joints, open_marker_topic
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, SourceLost
from bodyschema.interfaces.records import JointReading, frozen_array
from bodyschema.learning.snapshot import NoFrameError, Prediction

ROBOT = '[drivers.ros2]\nrouter = "tcp/robot:7447"\nnames = { waist = "joint_1" }\n'
MARKER = '[drivers.ros2.marker]\nframe = "eye"\n'


class Topic:
    """Recorder of what is published."""

    period_s = 0.1

    def __init__(self, *, has_sigma: bool = False, absent: int = 0) -> None:
        self.has_sigma, self.absent = has_sigma, absent
        self.told, self.heard = [], threading.Event()

    def __enter__(self):
        self.absent -= 1
        if self.absent >= 0:
            raise SourceLost("no router")
        return self

    def __exit__(self, *_) -> None:
        pass

    def publish(self, stamp_ns, x, sigma) -> None:
        self.told.append((stamp_ns, *x, *sigma))
        self.heard.set()


class Joints(Scripted):
    """Encoders with a clock of their own, which shows nanoseconds since 1000 s earlier."""

    stamp_ns: int | None = 7


class Clock:
    """A clock that a test sets."""

    t = 0.0

    def now(self) -> float:
        return self.t


class Model:
    """A model that says the same wherever the arm is."""

    def __init__(self, *, in_support: bool = True, has_frame: bool = True) -> None:
        self.in_support, self.has_frame = in_support, has_frame

    def predict(self, q) -> Prediction:
        if not self.has_frame:
            raise NoFrameError("too few samples")
        return Prediction(np.array([[1.0, 2.0, 3.0]]), np.array([[0.1, 0.2, 0.3]]), np.array([self.in_support]))


READING = JointReading(1.0, frozen_array([0.1, 0.2]))
TOLD = (7, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3)


def told(model: Model, topic: Topic, times=(0.0,)) -> list:
    clock = Clock()
    expected = ExpectedMarker(Joints([], ("a", "b")), topic, lambda: model, clock)
    for clock.t in times:
        expected.take(READING)
    return topic.told


def test_expected_position_carries_robot_timestamp() -> None:
    assert told(Model(), Topic()) == [TOLD]


def test_publishing_rate_is_limited() -> None:
    assert len(told(Model(), Topic(), np.arange(0.0, 0.995, 0.01))) == 10


def test_nothing_is_published_without_model() -> None:
    assert told(Model(has_frame=False), Topic()) == []


@pytest.mark.parametrize("has_sigma", [False, True])
def test_extrapolated_position_is_published_only_with_sigma(has_sigma) -> None:
    assert bool(told(Model(in_support=False), Topic(has_sigma=has_sigma))) == has_sigma


def test_a_robot_that_comes_later_is_waited_for(monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.interfaces.waits.Waits.retry_s", 0.0)
    topic = Topic(absent=3)
    readings = [JointReading(t, frozen_array([0.1, 0.2])) for t in (1.0, 2.0)]
    expected = ExpectedMarker(Joints(readings, ("a", "b")), topic, Model, SystemClock())
    with expected.publishing():
        assert topic.heard.wait(300.0)
    assert topic.told[0] == TOLD


# --- robot.toml


def load(folder, tables: str) -> Config:
    return Config.load(write_small_arm(folder, tables), {})


def test_the_topic_is_off_by_default(tmp_path) -> None:
    assert open_marker_topic(load(tmp_path, ""), SystemClock()) is None
    assert open_marker_topic(load(tmp_path, ROBOT), SystemClock()) is None


def test_the_topic_comes_with_the_robot_s_joints(tmp_path) -> None:
    found = open_marker_topic(load(tmp_path, ROBOT + MARKER), SystemClock())
    assert found is not None
    assert found[0].joints == ("waist", "shoulder")
    assert found[1].period_s == pytest.approx(1 / 30)


def test_joints_of_ros2_robot_use_ros2_driver(tmp_path) -> None:
    source = open_joints(load(tmp_path, ROBOT), SystemClock())
    assert source.joints == ("waist", "shoulder")
    assert type(source).__name__ == "Ros2Joints"


@pytest.mark.parametrize(
    ("tables", "says"),
    [
        ('[drivers.ros2]\nnames = { wrist = "joint_1" }\n', "unknown joint 'wrist'"),
        ('[drivers.ros2]\nnames = { waist = "shoulder" }\n', "two joints have the name 'shoulder'"),
        ('[drivers.ros2]\ntopic = "joint states"\n', "no name of a topic"),
        ('[drivers.ros2]\nrouter = "robot"\n', "no endpoint"),
        ("[drivers.ros2]\ndomain = 233\n", "domain"),
        ('[drivers]\nrecording = "walk.csv"\n' + ROBOT, "both a recording and ROS 2"),
        ("[drivers.ros2]\n", r"same endpoint .* Write in \[zenoh\]: sampler"),
        ('[drivers.ros2.marker]\nframe = "eye"\ntopic = "9"\n', "no name of a topic"),
    ],
)
def test_mistake_in_table_is_reported(tmp_path, tables, says) -> None:
    with pytest.raises(ConfigError, match=says):
        load(tmp_path, tables)
