"""Gaze of the demonstration's upper body on the emulator, in virtual time."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from gazing_robot import HEAD, GazingRobot

from bodyschema.daemon.transport.wire import JointsRequest, PredictReply, decode, encode
from bodyschema.drivers.dynamixel.emulator.arm import DrivenShaft
from bodyschema.drivers.dynamixel.emulator.servo import CURRENT_MODE
from bodyschema.interfaces.errors import RequestError
from bodyschema.robot.description import RobotDescription

TORQUE = 64
PATH_S = 4.0


def torque(robot: GazingRobot) -> list[int]:
    return [servo["torque"] for servo in robot.chain.servos]


def dropped(robot: GazingRobot, seconds: float = 3.0) -> str:
    """Read until gaze has ended; return why."""
    end = robot.clock.now() + seconds
    while robot.gaze.state == "on" and robot.clock.now() < end:
        robot.run(0.1)
    assert (robot.gaze.state, torque(robot)) == ("dropped", [0] * 7)
    return robot.gaze.complaints[0]


def test_gaze_keeps_hand_otherwise_lost_in_view() -> None:
    with (still := GazingRobot()).joints:
        without = still.in_view(still.run(PATH_S, looking=False))
    with (gazing := GazingRobot()).joints:
        gazing.switch_on()
        assert gazing.in_view(gazing.run(PATH_S)).all()
    assert without[0]
    assert without.mean() < 0.7


def test_head_stays_still_when_torque_goes_on() -> None:
    with (robot := GazingRobot()).joints:
        before = robot.q()[:2]
        robot.switch_on()
        robot.run(1.0, looking=False)
        assert np.abs(robot.q()[:2] - before).max() < math.radians(0.2)


def test_only_the_head_has_torque() -> None:
    with (robot := GazingRobot()).joints:
        robot.switch_on()
        robot.run(1.0)
        assert torque(robot) == [1, 1, 0, 0, 0, 0, 0]
    assert torque(robot) == [0] * 7


def test_the_head_turns_no_faster_than_allowed() -> None:
    with (robot := GazingRobot(rate_hz=250.0, max_speed_deg_s=5.0)).joints:
        robot.switch_on()
        angles = []
        for _ in range(30):
            robot.run(0.05)
            angles.append(robot.q()[:2])
        speeds = np.abs(np.diff(angles, axis=0)).max() / 0.05
        assert speeds < math.radians(5.0) * 1.3


def test_the_head_stays_within_its_limits() -> None:
    with (robot := GazingRobot(limits_deg={"neck_pitch": (15.0, 22.0), "neck_yaw": (-5.0, 5.0)})).joints:
        robot.switch_on()
        robot.run(1.0)
        for _ in range(12):
            robot.run(0.1)
            yaw, pitch = np.degrees(robot.q()[:2])
            assert -5.2 <= yaw <= 5.2
            assert 14.8 <= pitch <= 22.2


def test_a_head_without_a_fresh_aim_stands_still() -> None:
    with (robot := GazingRobot()).joints:
        robot.switch_on()
        robot.run(1.0)
        robot.run(0.7, looking=False)
        before = robot.q()[:2]
        robot.run(0.5, looking=False)
        assert robot.gaze.state == "on"
        assert np.abs(robot.q()[:2] - before).max() < 1e-6


@pytest.mark.parametrize("wrong", [[math.nan, 0.0], [0.0]])
def test_an_aim_that_is_none_moves_nothing(wrong) -> None:
    with (robot := GazingRobot()).joints:
        robot.switch_on()
        before = robot.q()[:2]
        robot.gaze.aim(robot.clock.now(), np.array(wrong))
        robot.run(0.4, looking=False)
        assert np.abs(robot.q()[:2] - before).max() < math.radians(0.2)


# --- by which model


def learner(robot: RobotDescription, truth, sigma: float, support: bool = True):
    def predict(payload: bytes) -> bytes:
        rows = np.array(decode(payload, JointsRequest).q)
        x = truth.positions(rows)
        count = len(rows)
        return encode(PredictReply(x.tolist(), [[sigma] * 3] * count, [support] * count, "m", 100, 0.1))

    return predict


def off_middle(robot: GazingRobot) -> float:
    with robot.joints:
        robot.switch_on()
        robot.run(0.7)
        return float(np.abs(robot.run(1.0) - [340.0, 239.5]).mean())


@pytest.fixture(scope="module")
def truth():
    robot = GazingRobot().robot
    return robot.chain.with_tool(np.array([0.05, 0.0, -0.15]))


@pytest.mark.soak
def test_good_learnt_model_is_used(truth) -> None:
    nominal = GazingRobot(truth=truth)
    learnt = GazingRobot(learner(nominal.robot, truth, 0.002), truth)
    assert off_middle(learnt) < 0.8 * off_middle(nominal)
    assert (learnt.model.source, nominal.model.source) == ("learnt", "nominal")


@pytest.mark.parametrize(("sigma", "support"), [(0.1, True), (0.002, False), (math.nan, True)])
def test_uncertain_or_unsupported_model_is_not_used(truth, sigma, support) -> None:
    robot = GazingRobot(learner(GazingRobot().robot, truth, sigma, support), truth)
    with robot.joints:
        robot.switch_on()
        robot.run(0.5)
    assert robot.model.source == "nominal"


# --- torque


def test_wrong_mode_error_names_the_fixing_command() -> None:
    robot = GazingRobot()
    robot.chain.servo(2)["operating_mode"] = CURRENT_MODE
    with robot.joints, pytest.raises(RequestError, match="bodyschema servos operating_mode=3 --joint neck_pitch"):
        robot.switch_on()
    assert torque(robot) == [0] * 7


def test_a_head_with_a_homing_offset_is_refused() -> None:
    robot = GazingRobot()
    robot.chain.servo(1)["homing_offset"] = 100
    with robot.joints, pytest.raises(RequestError, match="Homing Offset"):
        robot.switch_on()


def test_head_turned_by_a_revolution_stays_put() -> None:
    robot = GazingRobot()
    robot.heads[0].turn_by_hand(2 * math.pi)
    robot.chain.servo(1)["torque"] = 0
    with robot.joints:
        before = robot.heads[0](robot.clock.now())
        robot.switch_on()
        robot.run(0.5, looking=False)
        assert robot.heads[0](robot.clock.now()) == pytest.approx(before, abs=0.01)


def test_head_stays_when_switched_off_and_on_again() -> None:
    robot = GazingRobot()
    robot.heads[0].turn_by_hand(2 * math.pi)
    with robot.joints:
        robot.switch_on()
        before = robot.heads[0](robot.clock.now())
        robot.gaze.ask(False)
        assert "gaze is on" in robot.switch_on()
        robot.run(0.5, looking=False)
        assert robot.heads[0](robot.clock.now()) == pytest.approx(before, abs=0.01)


def test_a_head_that_is_held_fast_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bodyschema.drivers.dynamixel.gaze._Settings.blocked_deg", 8.0)  # the hand moves by little more
    with (robot := GazingRobot()).joints:
        robot.switch_on()
        robot.heads[1].jammed = True
        assert "'neck_pitch' stays" in dropped(robot, 12.0)


@pytest.mark.parametrize("bits", [0x04, 0x20])
def test_a_fault_ends_it(bits) -> None:
    with (robot := GazingRobot()).joints:
        robot.switch_on()
        robot.chain.servo(1).fail(bits)
        assert HEAD[0] in dropped(robot)


def test_head_stays_at_watchdog_stop_after_a_kill() -> None:
    with (robot := GazingRobot()).joints:
        robot.switch_on()
        robot.run(1.0)
        robot.gaze.aim(robot.clock.now(), np.radians([60.0, 20.0]))
        robot.run(0.05, looking=False)
        robot.clock.wait_until(robot.clock.now() + 0.15)
        stopped = robot.q()[:2]
        robot.clock.wait_until(robot.clock.now() + 5.0)
        assert np.abs(robot.q()[:2] - stopped).max() < math.radians(1.0)
        assert robot.chain.servo(1)["watchdog"] == -1


def test_nothing_is_written_to_an_eeprom() -> None:
    with (robot := GazingRobot()).joints:
        robot.switch_on()
        robot.run(1.0)
    assert min(address for address, _ in robot.port.writes()) >= TORQUE


@pytest.fixture
def often_switched() -> Iterator[None]:
    """Switch threads a thousand times as often as usual."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-3 * usual)
    yield
    sys.setswitchinterval(usual)


@pytest.mark.soak
def test_past_head_angle_is_stable_during_concurrent_turning(often_switched) -> None:
    shaft = DrivenShaft(0.5)
    turning = threading.Thread(target=lambda: [shaft(t) for t in range(5_000)])
    turning.start()
    seen = set()
    while turning.is_alive():
        seen.add(shaft(-1.0))
    assert seen == {0.5}
