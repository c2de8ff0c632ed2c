"""examples/correction/ros2_node.py publishes corrected joint states in addition to the raw ones."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import zenoh
from ros2_robot import PATHS

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.emulator.node import Node
from bodyschema.drivers.ros2.emulator.zenoh_robot import ZenohRobot
from bodyschema.drivers.ros2.link import open_session
from bodyschema.drivers.ros2.messages import JOINT_STATE, Header, JointState, decode_joint_state, encode_joint_state
from bodyschema.effects import Effect, Simulation
from bodyschema.effects.exports import write_correction
from bodyschema.robot.description import RobotDescription

READERS = Path(__file__).parents[2] / "examples" / "correction"
NAMES = tuple(PATHS)
LIMIT_S = 300.0


@pytest.fixture
def correction(tmp_path: Path) -> str:
    """Return offsets of 0.1, 0.2, ... rad at the emulated robot's joints."""
    links = "".join(f'<link name="l{k}"/>' for k in range(len(NAMES) + 1))
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/><origin xyz="0.1 0 0.1"/>'
        '<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        for k, name in enumerate(NAMES)
    )
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{links}{joints}</robot>')
    head = f'[robot]\nname = "arm"\nurdf = "arm.urdf"\njoints = {json.dumps(NAMES)}\nmarker_link = "l{len(NAMES)}"\n'
    (tmp_path / "robot.toml").write_text(f'{head}[camera]\nparent_link = "l0"\n')
    robot = RobotDescription.load(tmp_path / "robot.toml")
    offsets = [Effect.at(robot, "joint_offset", name, values=[0.1 * k]) for k, name in enumerate(NAMES, 1)]
    covariance = (1e-6 * np.eye(6)).ravel().tolist()
    write_correction(Simulation(robot, tuple(offsets)), tmp_path / "correction.json", "made by a test", covariance)
    return (tmp_path / "correction.json").read_text()


def samples(session: zenoh.Session, key: str) -> Iterator[zenoh.Sample]:
    heard = session.declare_subscriber(key, zenoh.handlers.RingChannel(1000))
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:
        if (sample := heard.try_recv()) is not None:
            yield sample
        time.sleep(0.005)


def test_corrected_joint_states_have_the_raw_ones_stamps(endpoint, correction, monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(READERS))
    from ros2_node import CorrectedJoints

    with ZenohRobot([Node(PATHS, 50.0)], endpoint) as arm, open_session(endpoint) as session:
        node = CorrectedJoints(session, correction, 0, "/joint_states")
        raw, seen = {}, 0
        with open_session(endpoint) as other:
            listening = samples(other, rmw.topic_key(0, "/joint_states$*", JOINT_STATE, rmw.ANY))
            as_json = samples(other, "bodyschema/arm/corrected")
            arm.start()
            for sample in listening:
                message = decode_joint_state(sample.payload.to_bytes())
                if "corrected" not in str(sample.key_expr):
                    raw[message.header.stamp_ns] = dict(zip(message.names, message.positions, strict=True))
                elif message.header.stamp_ns in raw:
                    assert rmw.sender_of(sample.attachment.to_bytes())[0] == node.gid
                    for k, (name, q) in enumerate(zip(message.names, message.positions, strict=True)):
                        expected = raw[message.header.stamp_ns][name] + 0.1 * (NAMES.index(name) + 1)
                        assert q == pytest.approx(expected, abs=1e-12), k
                    seen += 1
                    if seen == 3:
                        break
            marker = json.loads(next(as_json).payload.to_string())["marker"]
            assert [len(row) for row in marker["matrix"]] == [4] * 4
            assert len(marker["quaternion_xyzw"]) == 4
            assert np.array_equal(np.reshape(marker["covariance"], (6, 6)), 1e-6 * np.eye(6))


def test_an_unknown_covariance_has_its_reason(correction, monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(READERS))
    from ros2_node import CorrectedJoints

    session, sample = MagicMock(), MagicMock()
    without = json.dumps(json.loads(correction) | {"pose_covariance": None})
    message = JointState(Header(1, ""), NAMES, (0.1,) * len(NAMES))
    sample.payload.to_bytes.return_value = encode_joint_state(message)
    CorrectedJoints(session, without, 0, "/joint_states").take(sample)
    marker = json.loads(session.declare_publisher.return_value.put.call_args[0][0])["marker"]
    assert marker["covariance"] is None
    assert "diagnosis.json" in marker["covariance_unknown"]


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
def test_joint_state_with_non_finite_position_is_skipped(wrong, correction, monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(READERS))
    from ros2_node import CorrectedJoints

    node = CorrectedJoints(MagicMock(), correction, 0, "/joint_states")
    sample = MagicMock()
    for position, published in ((wrong, 0), (0.1, 1)):
        message = JointState(Header(1, ""), NAMES, (position, *[0.2] * (len(NAMES) - 1)))
        sample.payload.to_bytes.return_value = encode_joint_state(message)
        node.take(sample)
        assert node.sequence == published
