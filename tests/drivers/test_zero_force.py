"""Zero-force of emulated pendulums, in virtual time."""

from __future__ import annotations

import logging
import math

import msgspec
import numpy as np
import pytest
from floating_arm import CONSTANT, INERTIA, WEIGHT_N_M, FloatingArm, holding
from virtual_port import VirtualClock, VirtualPort

from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.frames import Code
from bodyschema.drivers.dynamixel.emulator.servo import CURRENT_MODE, POSITION_MODE, Servo
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.dynamixel.powered_config import FloatingJoint, ZeroForceConfig
from bodyschema.drivers.dynamixel.zero_force import ZeroForce
from bodyschema.drivers.emulator.faults import mute
from bodyschema.interfaces.errors import RequestError, SourceError, SourceLost

DRIFT_RAD = math.radians(0.5)  # allowed drift of the arm in ten seconds after its release
LATE_S = 0.015  # from overspeed to torque off: the servo's measurement, a cycle, and the motion meanwhile
TORQUE, GOAL_CURRENT, WATCHDOG = 64, 102, 98


def dropped(arm: FloatingArm, seconds: float = 2.0) -> str:
    """Read until zero-force has ended; why."""
    end = arm.clock.now() + seconds
    while arm.force.state == "on" and arm.clock.now() < end:
        arm.joints.read(0.02)
    assert (arm.force.state, arm.torque) == ("dropped", [0] * len(arm.names))
    assert not any(arm.currents())
    return arm.force.complaints[0]


# --- bearing the arm


def test_the_arm_floats_where_it_is_left() -> None:
    with (arm := FloatingArm((0.3, -0.4, 1.2))).joints:
        arm.float()
        before = arm.q
        arm.run(1.0)
        assert arm.force.state == "on"
        assert np.abs(np.subtract(arm.q, before)).max() < DRIFT_RAD / 10


def test_the_arm_falls_without_zero_force() -> None:
    with (arm := FloatingArm()).joints:
        arm.run(0.5)
        arm.let_go()
        before = arm.q
        arm.run(0.3)
        assert min(b - a for a, b in zip(arm.q, before, strict=True)) > math.radians(20)


def test_a_hand_moves_it_and_it_stays_there() -> None:
    with (arm := FloatingArm()).joints:
        arm.float()
        arm.pendulums[0].pushed = 0.04
        arm.run(1.0)
        arm.pendulums[0].pushed = 0.0
        arm.run(2.0)
        moved = arm.q[0]
        arm.run(0.5)
        assert moved > 0.4
        assert abs(arm.q[0] - moved) < DRIFT_RAD / 20


@pytest.mark.parametrize("directions", [(1, -1), pytest.param((-1, 1), marks=pytest.mark.soak)])
def test_joint_counting_against_its_servo_floats(directions) -> None:
    with (arm := FloatingArm(directions=directions)).joints:
        arm.float()
        before = arm.q
        arm.run(1.0)
        assert np.abs(np.subtract(arm.q, before)).max() < DRIFT_RAD


def test_servo_with_reverse_drive_mode_floats() -> None:
    arm = FloatingArm(told_directions=(-1, 1))
    arm.chain.servo(1)["drive_mode"] = 1
    arm.chain.servo(1).reboot(arm.clock.now())
    with arm.joints:
        arm.float()
        before = arm.q
        arm.run(1.0)
        assert arm.force.state == "on"
        assert np.abs(np.subtract(arm.q, before)).max() < DRIFT_RAD


def test_two_series_on_two_buses_get_their_currents() -> None:
    models, clock = {"left": "XM430-W350", "right": "PH54-200-S500"}, VirtualClock()
    servos = {name: Servo(BY_NAME[model], 1, lambda t: 0.5, return_delay_s=0.0) for name, model in models.items()}
    for servo in servos.values():
        servo["operating_mode"] = CURRENT_MODE
    table = ZeroForceConfig(joints={name: FloatingJoint(current_limit_a=1.0) for name in models})
    config = DynamixelConfig(
        {name: BusConfig(name) for name in models},
        tuple(ServoConfig(name, 1, model, bus=name) for name, model in models.items()),
        zero_force=table,
    )
    force = ZeroForce(config, table, tuple(models), lambda q: np.array([0.5, -2.0]), clock)
    ports = {name: VirtualPort(Chain([servo]), clock) for name, servo in servos.items()}
    answer = force.ask(True)
    with DynamixelJoints(
        config, tuple(models), clock, open_port=lambda bus, _: (ports[bus.port], 0.0), drives=[force]
    ) as joints:
        end = clock.now() + 1.3
        while clock.now() < end:
            joints.read(0.02)
        assert answer.done()
        currents = [servo.motor_current(clock.now()) for servo in servos.values()]
    assert currents == pytest.approx([0.5 / (4.1 / 2.3), -2.0 / (44.7 / 9.3)], abs=3e-3)
    assert [servo["torque"] for servo in servos.values()] == [0, 0]


def test_the_currents_grow_within_a_second() -> None:
    with (arm := FloatingArm((0.0,))).joints:
        arm.switch_on()
        full = WEIGHT_N_M / CONSTANT
        arm.run(0.5)
        assert arm.currents()[0] == pytest.approx(0.5 * full, abs=0.02)
        arm.run(0.6)
        assert arm.currents()[0] == pytest.approx(full, abs=0.005)


def test_current_limit_holds_and_sinking_joint_is_named() -> None:
    with (arm := FloatingArm((0.0, -1.5), current_limit_a=0.4)).joints:
        arm.switch_on()
        arm.run(2.5)
        assert max(map(abs, arm.currents())) <= 0.4 + 1e-3
        assert "current limit of joint1 does not bear the arm" in arm.force.complaints[0]


def test_a_share_of_the_weight_is_borne() -> None:
    with (arm := FloatingArm((0.0,), share=0.5)).joints:
        arm.switch_on()
        arm.run(1.2)
        assert arm.currents()[0] == pytest.approx(0.5 * WEIGHT_N_M / CONSTANT, abs=5e-3)


def test_readings_are_as_many_as_without() -> None:
    rates = {}
    for on in (False, True):
        with (arm := FloatingArm((0.1,) * 6, rate_hz=250.0)).joints:
            if on:
                arm.switch_on()
            rates[on] = arm.run(0.5)
    assert rates[True] > 0.97 * rates[False]


# --- torque on


def test_torque_stays_off_before_a_request() -> None:
    with (arm := FloatingArm()).joints:
        arm.run(0.5)
        assert arm.force.state == "off"
    assert arm.port.writes() == []


def test_zero_goal_and_watchdog_precede_torque() -> None:
    with (arm := FloatingArm()).joints:
        arm.switch_on()
    addresses = [address for address, _ in arm.port.writes()]
    first = addresses.index(TORQUE)
    assert addresses[:first] == [WATCHDOG, GOAL_CURRENT, WATCHDOG] * 2
    assert [data for address, data in arm.port.writes()[:first] if address == GOAL_CURRENT] == [b"\0\0"] * 2


def test_nothing_is_written_to_an_eeprom() -> None:
    with (arm := FloatingArm()).joints:
        arm.float()
        arm.run(1.0)
        arm.ask(on=False)
    assert min(address for address, _ in arm.port.writes()) >= TORQUE


def test_wrong_mode_error_names_the_fixing_command() -> None:
    with (arm := FloatingArm(mode=POSITION_MODE)).joints:
        with pytest.raises(RequestError, match="bodyschema servos operating_mode=0 --joint joint1"):
            arm.switch_on()
        assert arm.torque == [0, 0]


def test_a_limit_beyond_the_servo_s_own_is_refused() -> None:
    arm = FloatingArm(current_limit_a=2.5)
    arm.chain.servo(2)["current_limit"] = 500
    with arm.joints, pytest.raises(RequestError, match=r"'joint2' .* own Current Limit is 1.3\d A"):
        arm.switch_on()
    assert arm.torque == [0, 0]


def test_partial_torque_on_is_undone_everywhere() -> None:
    arm = FloatingArm()
    arm.chain.servo(2).fail(0x20)
    with arm.joints:
        servo = arm.chain.servo(2)
        allowed = servo.write
        servo.write = lambda address, data, t: allowed(address, b"\0" if address == TORQUE else data, t)
        with pytest.raises(RequestError, match="'joint2': its torque does not go on"):
            arm.switch_on()
        assert arm.torque == [0, 0]


def test_cancelled_request_does_nothing() -> None:
    with (arm := FloatingArm()).joints:
        arm.force.ask(True).cancel()
        arm.run(0.5)
        assert arm.force.state == "off"


def test_torque_goes_off_when_asked_and_is_verified() -> None:
    with (arm := FloatingArm()).joints:
        arm.float()
        assert "verified off" in arm.ask(on=False)
        assert (arm.torque, arm.force.state, arm.force.complaints) == ([0, 0], "off", ())


# --- everything else ends in torque off


def test_torque_is_off_after_the_end() -> None:
    with (arm := FloatingArm()).joints:
        arm.float()
    assert arm.torque == [0, 0]


def test_torque_is_off_after_any_exception() -> None:
    arm = FloatingArm()

    def fail() -> None:
        with arm.joints:
            arm.float()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert arm.torque == [0, 0]


def test_speed_limit_stops_arm_with_wrong_direction() -> None:
    with (arm := FloatingArm((-0.5, 0.3), directions=(1, 1), torques=lambda q: -holding(q), rate_hz=250.0)).joints:
        arm.float()
        assert "turned at" in dropped(arm)
        gained = 2 * WEIGHT_N_M / INERTIA * LATE_S
        assert max(abs(pendulum.v) for pendulum in arm.pendulums) < math.radians(90) + gained


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_torque_that_is_no_number_ends_it(wrong) -> None:
    def torques(q):
        return np.where(q < 0.5, holding(q), wrong)

    with (arm := FloatingArm(torques=torques)).joints:
        arm.float()
        arm.pendulums[0].pushed = 0.05
        assert "gives no torque" in dropped(arm)


def test_a_model_that_fails_ends_it() -> None:
    with (arm := FloatingArm(torques=lambda q: 1 / 0)).joints:
        arm.switch_on()
        assert "ZeroDivisionError" in dropped(arm)


@pytest.mark.parametrize("bits", [0x01, *(pytest.param(bit, marks=pytest.mark.soak) for bit in (4, 8, 0x10)), 0x20])
def test_a_fault_of_one_servo_ends_all(bits) -> None:
    with (arm := FloatingArm()).joints:
        arm.float()
        arm.chain.servo(2).fail(bits)
        assert "joint2" in dropped(arm)


def test_a_hot_servo_ends_it() -> None:
    with (arm := FloatingArm()).joints:
        arm.float()
        arm.chain.servo(1)["temperature"] = 66
        assert "66 °C" in dropped(arm)


def test_a_servo_that_lost_its_torque_ends_it() -> None:
    with (arm := FloatingArm(rate_hz=250.0)).joints:
        arm.float()
        arm.chain.servo(1)["torque"] = 0
        assert "lost torque" in dropped(arm)


def test_sustained_overcurrent_ends_zero_force() -> None:
    with (arm := FloatingArm()).joints:
        arm.float()
        arm.chain.servo(1).excess_a = 2.0
        assert "drew 2.6" in dropped(arm)


def test_a_program_that_is_held_up_ends_it() -> None:
    with (arm := FloatingArm()).joints:
        arm.float()
        arm.clock.wait_until(arm.clock.now() + 0.3)
        assert not any(arm.currents())  # by their watchdogs, before anybody else can do something
        assert "held up" in dropped(arm) or "heard nothing" in arm.force.complaints[0]


def test_readings_that_are_doubtful_for_long_end_it() -> None:
    with (arm := FloatingArm(heartbeat_ms=500, rate_hz=250.0)).joints:
        arm.float()
        arm.faults.add(1, mute, 20)
        assert "could not be believed" in dropped(arm)


def test_a_few_doubtful_readings_do_not() -> None:
    with (arm := FloatingArm()).joints:
        arm.float()
        arm.faults.add(1, mute, 3)
        arm.run(1.0)
        assert arm.force.state == "on"


def test_a_servo_that_takes_no_goals_ends_it() -> None:
    with (arm := FloatingArm()).joints:
        arm.float()
        servo = arm.chain.servo(1)
        servo["current_limit"] = 100  # larger values are refused without an error
        arm.pendulums[0].pushed = 0.05
        assert "does not take its goal" in dropped(arm)


def test_zero_force_stays_off_after_lost_bus_returns(monkeypatch) -> None:
    arm = FloatingArm()
    write = arm.port.write

    def gone(data):
        raise SourceLost("the port is gone", retry_s=0.1)

    with arm.joints:
        arm.float()
        monkeypatch.setattr(arm.port, "write", gone)
        with pytest.raises(SourceLost):
            arm.run(1.0)
        assert "switch the supply off" in arm.force.complaints[0]
        arm.clock.wait_until(arm.clock.now() + 0.2)
        assert not any(arm.currents())  # by their watchdogs
    monkeypatch.setattr(arm.port, "write", write)
    with arm.joints:
        arm.let_go()
        arm.run(0.1)
        assert arm.torque == [0, 0]
        assert arm.force.state == "dropped"
        assert not any("switch the supply off" in text for text in arm.force.complaints)


def test_torque_of_mute_servo_is_off_but_unverified() -> None:
    with (arm := FloatingArm(heartbeat_ms=500)).joints:
        arm.float()
        arm.faults.add(1, mute)
        with pytest.raises(SourceError):
            arm.run(3.0)
        assert arm.torque == [0, 0]
        assert "joint1 could not be verified off" in arm.force.complaints[0]


def test_one_dropped_drive_drops_the_other() -> None:
    arm = FloatingArm()
    tables = [msgspec.structs.replace(arm.table, joints={name: arm.table.joints[name]}) for name in arm.names]
    drives = [ZeroForce(arm.config, table, arm.names, holding, arm.clock) for table in tables]
    arm.joints = DynamixelJoints(arm.config, arm.names, arm.clock, open_port=lambda *_: (arm.port, 0.0), drives=drives)
    with arm.joints:
        answers = [drive.ask(True) for drive in drives]
        while not all(answer.done() for answer in answers):
            arm.joints.read(0.02)
        assert arm.torque == [1, 1]
        arm.chain.servo(2)["temperature"] = 70
        arm.run(1.0)
        assert (arm.torque, [drive.state for drive in drives]) == ([0, 0], ["dropped"] * 2)


def test_drop_is_logged_once_and_restarts_on_request(caplog) -> None:
    with caplog.at_level(logging.ERROR), (arm := FloatingArm()).joints:
        arm.float()
        arm.chain.servo(1)["temperature"] = 70
        dropped(arm)
        arm.chain.servo(1)["temperature"] = 30
        for pendulum in arm.pendulums:
            pendulum.held_until = math.inf
        arm.run(3.0)
        assert arm.torque == [0, 0]
        assert len(caplog.messages) == 1
        arm.float()
        arm.run(1.0)
        assert (arm.force.state, arm.force.complaints) == ("on", ())


def test_watchdogs_stop_killed_arm_and_next_program_recovers() -> None:
    arm = FloatingArm()
    with arm.joints:
        arm.float()
        sent = [i.code for i in arm.port.heard]
        arm.clock.wait_until(arm.clock.now() + 0.13)  # heartbeat of 100 ms; all is silent
        assert sent.count(Code.SYNC_WRITE) > 100
        assert not any(arm.currents())
        assert [servo["watchdog"] for servo in arm.chain.servos] == [-1, -1]
        again = FloatingArm()
        again.port, again.chain, again.clock = arm.port, arm.chain, arm.clock
        again.force._clock = again.joints._clock = arm.clock
        with again.joints:
            assert arm.torque == [0, 0]
            answer = again.force.ask(True)
            again.joints.read(0.02)
            assert answer.done()
            assert "bear the arm" in answer.result()
