"""Health reports of a servo arm, and the question asked when a joint lost its turn count."""

from __future__ import annotations

import math

import pytest
from emulated_arm import Arm
from feetech_arm import FeetechArm
from servo_arm import swing

from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.feetech.emulator.servo import Servo as FeetechServo
from bodyschema.interfaces.errors import SourceError, SourceLost

MAKES = [Arm, FeetechArm]


def read(arm, count: int) -> list:
    return [arm.joints.read(1.0) for _ in range(count)]


def health(arm) -> dict:
    return dict(arm.joints.servo_health)


@pytest.mark.parametrize("make", MAKES, ids=["dynamixel", "feetech"])
def test_servos_report_voltage_and_temperature_within_a_second(make) -> None:
    arm = make()
    with arm.joints:
        read(arm, 250)
        told = health(arm)
    assert {servo.temperature_c for servo in told.values()} == {31.0}
    assert all(servo.voltage_v is not None and servo.voltage_v > 7.0 for servo in told.values())


@pytest.mark.parametrize("make", MAKES, ids=["dynamixel", "feetech"])
def test_only_the_overloaded_servo_reports_trouble(make) -> None:
    arm = make()
    with arm.joints:
        arm.chain.servo(2).fail(0x20)
        read(arm, 250)
        troubles = {joint: servo.troubles for joint, servo in health(arm).items()}
    assert troubles["joint2"][0].startswith("it is overloaded: free the joint")
    assert troubles["joint1"] == troubles["joint3"] == []


@pytest.mark.parametrize("make", MAKES, ids=["dynamixel", "feetech"])
def test_torque_that_stays_on_is_an_error(make, monkeypatch) -> None:
    arm = make()
    servo = arm.chain.servo(2)
    servo["torque"] = 1
    monkeypatch.setattr(type(servo), "write", lambda *_: 0)
    with pytest.raises(SourceError, match=r"torque of joint 'joint2' \(ID 2\) stays on"), arm.joints:
        pytest.fail("it was opened")


@pytest.mark.parametrize("make", MAKES, ids=["dynamixel", "feetech"])
def test_silent_servo_is_marked_until_it_returns(make) -> None:
    arm = make()
    with arm.joints:
        gone = arm.chain.servos.pop(1)
        with pytest.raises(SourceLost):
            read(arm, 500)
        assert health(arm)["joint2"].troubles[0].startswith("no answer: look at its supply")
        assert health(arm)["joint1"].troubles == []
    arm.chain.servos.insert(1, gone)
    with arm.joints:
        assert health(arm)["joint2"].troubles == []


def test_a_bus_counts_its_troubles_over_all_openings() -> None:
    arm = Arm()
    for _ in range(2):
        with arm.joints:
            read(arm, 10)
    asked = arm.joints.bus_health["arm"].exchanges
    assert asked > 20
    assert arm.joints.bus_health["arm"].troubles == {}


def test_servos_of_a_missing_port_are_marked() -> None:
    arm = Arm()
    with arm.joints:
        read(arm, 3)

    def gone(*_):
        raise SourceLost("unplugged")

    arm.joints._open_port = gone
    with pytest.raises(SourceLost), arm.joints:
        pytest.fail("it was opened")
    troubles = [servo.troubles for servo in arm.joints.servo_health.values()]
    assert troubles == [["its bus is away: look at the adapter's cable"]] * len(arm.joints.joints)


@pytest.mark.parametrize("model", ["XM430-W350", "MX-28", "AX-12A"])
def test_identical_dynamixel_servos_sharing_an_id_are_refused(model) -> None:
    arm = Arm((model,) * 3)
    arm.chain.servos.append(Servo(arm.chain.servo(2).model, 2, lambda t: swing(0)(t) + 0.4, return_delay_s=0))
    with pytest.raises(SourceError, match=r"joint2 +2 .* garbled answers: two servos with this ID"), arm.joints:
        pytest.fail("it was opened")


def test_identical_feetech_servos_sharing_an_id_are_refused() -> None:
    arm = FeetechArm()
    arm.chain.servos.append(FeetechServo(arm.chain.servo(2).model, 2, lambda t: swing(0)(t) + 0.4, return_delay_s=0))
    with pytest.raises(SourceError, match=r"joint2 +2 .* garbled answers: two servos with this ID"), arm.joints:
        pytest.fail("it was opened")


def test_lost_turn_count_needs_explicit_acceptance() -> None:
    turned = [0.0]
    arm = Arm(paths=[lambda t: 0.1, lambda t: 0.2 + turned[0], lambda t: 0.3])
    with arm.joints:
        read(arm, 3)
    turned[0] = math.radians(100)
    arm.chain.power_cycle(arm.clock.now())
    for _ in range(2):
        with pytest.raises(SourceLost, match=r"joint2.*accept_turns"), arm.joints:
            pytest.fail("it was opened")
    assert arm.joints.asks_for_turns
    assert health(arm)["joint2"].troubles[0].startswith("its turn count is lost")
    arm.joints.accept_turns()
    with arm.joints:
        (reading,) = read(arm, 1)
    assert reading.q[1] == pytest.approx(0.2 + math.radians(100), abs=0.01)
    assert not arm.joints.asks_for_turns


def test_turn_acceptance_holds_for_one_loss() -> None:
    turned = [0.0]
    arm = Arm(paths=[lambda t: 0.1, lambda t: 0.2 + turned[0], lambda t: 0.3])
    with arm.joints:
        read(arm, 3)
    for angle in (100.0, 200.0):
        turned[0] = math.radians(angle)
        arm.chain.power_cycle(arm.clock.now())
        with pytest.raises(SourceLost, match="turn count is lost"), arm.joints:
            pytest.fail("it was opened")
        arm.joints.accept_turns()
        with arm.joints:
            read(arm, 1)


def test_turn_acceptance_without_a_question_has_no_effect() -> None:
    turned = [0.0]
    arm = Arm(paths=[lambda t: 0.1, lambda t: 0.2 + turned[0], lambda t: 0.3])
    for angle in (0.0, 100.0):
        turned[0] = math.radians(angle)
        arm.joints.accept_turns()  # without a question
        if angle:
            with pytest.raises(SourceLost, match="turn count"), arm.joints:
                pytest.fail("it was opened")
        else:
            with arm.joints:
                read(arm, 1)
