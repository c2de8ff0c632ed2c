"""The driver on the emulator, in virtual time."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from random import Random

import numpy as np
import pytest
from emulated_arm import Arm
from servo_arm import TICK, swing
from virtual_port import VirtualClock, VirtualPort
from wire_faults import storm

from bodyschema.drivers.dynamixel.config import BusConfig, DynamixelConfig, ServoConfig
from bodyschema.drivers.dynamixel.emulator.arm import swapped
from bodyschema.drivers.dynamixel.emulator.chain import Chain
from bodyschema.drivers.dynamixel.emulator.servo import Servo
from bodyschema.drivers.dynamixel.joints import DynamixelJoints
from bodyschema.drivers.dynamixel.models import BY_NAME
from bodyschema.drivers.emulator.faults import corrupt, garbage, half, late, mute, wrong_checksum
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.records import JointReading

FAULTS = [mute, late(0.02), wrong_checksum, corrupt(), half, garbage, swapped]
MIXED = ("XM430-W350", "PH54-200-S500", "MX-28", "AX-12A", "MX-64(2.0)", "XL330-M288")
FAST = 0.9  # [rad/s], the arm's largest speed; plus half a tick


def read(arm: Arm, count: int = 1) -> list[JointReading]:
    found = []
    while len(found) < count:
        reading = arm.joints.read(0.1)
        if reading is not None:
            found.append(reading)
    return found


@pytest.mark.parametrize("models", [("XM430-W350",) * 3, MIXED])
@pytest.mark.parametrize("fast", ["auto", "never"])
def test_reading_matches_each_joint_angle_when_sampled(models, fast) -> None:
    with (arm := Arm(models, fast=fast)).joints:
        for _ in range(50):
            reading = read(arm)[0]
            for q, servo in zip(reading.q, arm.chain.servos, strict=True):
                off = abs(q - arm.chain.samplings[servo.id].angle)
                assert off <= servo.model.rad_per_tick / 2 + 1e-12


def test_one_tick_is_exactly_a_turn_by_4096() -> None:
    with (arm := Arm(paths=[lambda t: 1000 * TICK, lambda t: math.pi / 2, lambda t: -math.pi / 2])).joints:
        assert read(arm)[0].q.tolist() == [1000 * TICK, math.pi / 2, -math.pi / 2]


def test_direction_and_zero_come_from_the_configuration() -> None:
    servo, clock = Servo(BY_NAME["XM430-W350"], 1, lambda t: 0.5), VirtualClock()
    config = DynamixelConfig({"a": BusConfig("x")}, (ServoConfig("j", 1, "XM430-W350", direction=-1, zero_ticks=0),))
    port = VirtualPort(Chain([servo]), clock)
    with DynamixelJoints(config, ("j",), clock, open_port=lambda *_: (port, 0.0)) as joints:
        reading = joints.read(0.1)
    assert reading is not None
    assert reading.q[0] == -(round(0.5 / TICK) + 2048) * TICK


def test_two_buses_make_one_reading() -> None:
    clock, config = VirtualClock(), {"left": BusConfig("l"), "right": BusConfig("r")}
    entries = tuple(ServoConfig(bus, 1, "XM430-W350", bus=bus) for bus in config)
    ports = {
        name: VirtualPort(Chain([Servo(BY_NAME["XM430-W350"], 1, swing(k))]), clock) for k, name in enumerate("lr")
    }
    joints = DynamixelJoints(
        DynamixelConfig(config, entries), ("left", "right"), clock, open_port=lambda bus, _: (ports[bus.port], 0.0)
    )
    with joints:
        reading = joints.read(0.1)
    assert reading is not None
    assert reading.q == pytest.approx([swing(0)(reading.t), swing(1)(reading.t)], abs=TICK)


# --- torque and settings


def test_torque_is_off_before_readings_and_stays_off() -> None:
    arm = Arm()
    arm.chain.servo(2)["torque"] = 1
    with arm.joints:
        assert [servo["torque"] for servo in arm.chain.servos] == [0, 0, 0]
        read(arm, 100)
    assert arm.port.writes() == [(64, b"\x00")]
    assert [servo.had_torque for servo in arm.joints.servos] == [False, True, False]


@pytest.mark.parametrize("models", [("XM430-W350",) * 3, MIXED])
def test_nothing_is_written_where_nothing_needs_to_be(models) -> None:
    with (arm := Arm(models)).joints:
        read(arm, 100)
    assert arm.port.writes() == []


def test_torque_is_switched_off_though_answers_get_lost() -> None:
    arm = Arm()
    arm.chain.servo(2)["torque"] = 1
    arm.faults.add(2, mute, 2)
    with arm.joints:
        assert arm.chain.servo(2)["torque"] == 0


def test_torque_switched_on_meanwhile_is_found_and_cleared() -> None:
    arm = Arm()
    with arm.joints:
        read(arm)
        arm.chain.servo(3)["torque"] = 1
        with pytest.raises(SourceLost, match="torque of joint 'joint3' was switched on by another program"):
            read(arm, 1000)
    with arm.joints:
        assert arm.chain.servo(3)["torque"] == 0


def test_torque_is_restored_where_on_if_requested() -> None:
    arm = Arm(("XM430-W350", "AX-12A", "XM430-W350"), restore_torque=True)
    arm.chain.servo(1)["torque"] = arm.chain.servo(2)["torque"] = 1
    with arm.joints:
        read(arm)
    assert [servo["torque"] for servo in arm.chain.servos] == [1, 1, 0]
    for id in (1, 2):
        assert abs(arm.chain.servo(id)["goal"] - arm.chain.servo(id).count(arm.clock.now())) <= 3


def test_torque_stays_off_between_loss_and_reopening() -> None:
    arm = Arm(restore_torque=True)
    arm.chain.servo(1)["torque"] = 1
    with arm.joints:
        read(arm)
        arm.chain.servo(3).reboot(arm.clock.now())
        with pytest.raises(SourceLost):
            read(arm, 100)
    assert arm.chain.servo(1)["torque"] == 0
    with arm.joints:
        read(arm)
    assert [servo["torque"] for servo in arm.chain.servos] == [1, 0, 0]


def test_record_holds_the_settings_of_each_servo() -> None:
    arm = Arm()
    arm.chain.servo(1)["homing_offset"] = -17
    with arm.joints:
        kept = arm.joints.record[0]
    assert (kept["model"], kept["firmware"], kept["homing_offset_ticks"]) == ("XM430-W350", 46, -17)


# --- servos present


def test_missing_and_wrong_servos_share_one_table() -> None:
    arm = Arm(("XM430-W350", "XM430-W350", "XL330-M288"))
    arm.chain.servos[1:] = [Servo(BY_NAME["XL430-W250"], 3, swing(0))]
    with pytest.raises(SourceError) as refusal, arm.joints:
        pass
    assert str(refusal.value).splitlines()[:-1] == [
        "the servos on emulator are not those of robot.toml:",
        "  joint   ID  expected    found",
        "  joint1  1   XM430-W350  XM430-W350",
        "  joint2  2   XM430-W350  no answer",
        "  joint3  3   XL330-M288  XL430-W250: wrong model",
    ]


def test_two_servos_of_one_id_are_refused() -> None:
    arm = Arm()
    arm.chain.servos.append(Servo(BY_NAME["XL430-W250"], 2, swing(9), return_delay_s=0))
    with pytest.raises(SourceError, match=r"joint2 .* two servos with this ID"), arm.joints:
        pass


def test_servo_answering_only_ping_names_status_level() -> None:
    arm = Arm()
    arm.chain.servo(1)["status_return"] = 0
    with (
        pytest.raises(
            SourceError, match=r"answers PING but no READ: its Status Return Level .* supply is switched off"
        ),
        arm.joints,
    ):
        pass


def test_gone_port_is_reported_by_readings_not_temperature() -> None:
    def gone(_: bytes) -> None:
        raise SourceLost("the port is gone")

    arm = Arm()
    with arm.joints:
        read(arm)
        arm.port.write = gone
        assert arm.joints.temperature_c("joint1") is None
        with pytest.raises(SourceLost, match="the port is gone"):
            read(arm)


def test_a_servo_at_another_rate_does_not_answer() -> None:
    arm = Arm()
    arm.chain.servo(1)["baud"] = 1
    with pytest.raises(SourceLost, match=r"joint1 .* no answer"), arm.joints:
        pass


@pytest.mark.parametrize(("knows", "fast"), [(True, True), (False, False)])
def test_fast_sync_read_requires_support_by_all_servos(knows, fast) -> None:
    arm = Arm()
    arm.chain.servo(2).fast = knows
    with arm.joints:
        read(arm, 10)
    assert (arm.port.heard[-1].code == 0x8A) is fast


# --- faults


@pytest.mark.parametrize("fault", FAULTS, ids=range(len(FAULTS)))
@pytest.mark.parametrize(
    ("models", "fast"),
    [
        (("XM430-W350",) * 3, "auto"),
        (MIXED, "never"),
        pytest.param(("XM430-W350",) * 3, "never", marks=pytest.mark.soak),
        pytest.param(MIXED, "auto", marks=pytest.mark.soak),
    ],
)
def test_a_fault_costs_a_reading_and_nothing_else(fault, models, fast) -> None:
    with (arm := Arm(models, fast=fast)).joints:
        read(arm, 10)
        for id in range(1, len(models) + 1):
            arm.faults.add(id, fault, 1)
            readings = read(arm, 20)
            assert max(arm.error(reading) for reading in readings) < 3e-3 + TICK * 2
    assert arm.joints.epoch == 1


def test_late_answer_is_not_matched_to_next_request() -> None:
    steep = [lambda t: 8.0 * math.sin(t), lambda t: 0.0, lambda t: 0.0]
    with (arm := Arm(paths=steep, fast="never")).joints:
        for k in range(60):
            arm.faults.add(1, lambda reply, _, by=k * 1e-3: replace(reply, start=reply.start + by), 1)
            for reading in read(arm, 3):
                assert abs(reading.q[0] - steep[0](reading.t)) < 8.0 * 0.6e-3 + TICK


def test_alert_keeps_readings_and_reports_the_remedy(caplog) -> None:
    with caplog.at_level(logging.WARNING), (arm := Arm()).joints:
        arm.chain.servo(2).fail(0x20)
        assert max(arm.error(reading) for reading in read(arm, 200)) < 2 * TICK
        assert arm.joints.health == (
            "joint 'joint2': it is overloaded: free the joint, then switch its supply off and on",
        )
        assert len(caplog.messages) == 1
        arm.chain.servo(2)["hardware_error"] = 0
        read(arm, 200)
        assert arm.joints.health == ()


def test_mute_servo_does_not_discard_other_answers() -> None:
    with (arm := Arm(fast="never")).joints:
        read(arm)
        arm.faults.add(3, mute)
        before = arm.joints.samples["joint1"]
        assert arm.joints.read(0.02) is None
        assert arm.joints.samples["joint1"] is not before


def test_a_servo_that_stays_mute_is_named() -> None:
    arm = Arm()
    with arm.joints:
        read(arm)
        arm.chain.servos.pop(1)
        with pytest.raises(SourceLost, match=r"joint 'joint2' \(ID 2\): no answer"):
            read(arm, 1000)


@pytest.mark.parametrize("fast", ["auto", "never"])
def test_an_encoder_s_glitch_is_not_believed(fast) -> None:
    with (arm := Arm(fast=fast)).joints:
        read(arm)
        arm.chain.servo(2).glitch_ticks = 300
        assert arm.joints.read(0.008) is None
        arm.chain.servo(2).glitch_ticks = 0
        assert max(arm.error(reading) for reading in read(arm, 20)) < 2 * TICK


def test_permanent_encoder_jump_starts_another_epoch() -> None:
    arm = Arm(limits=[(-2.0, 2.0)] * 3)
    with arm.joints:
        read(arm)
        arm.chain.servo(2).glitch_ticks = 300
        with pytest.raises(SourceLost, match=r"'joint2' .* a position where it cannot have come to"):
            read(arm, 100)
    with arm.joints:
        assert read(arm)[0].q[1] == pytest.approx(arm.paths[1](arm.clock.now()) + 300 * TICK, abs=0.01)
    assert arm.joints.epoch == 2


def test_a_servo_that_was_restarted_is_another_epoch() -> None:
    arm = Arm()
    with arm.joints:
        read(arm)
        arm.chain.servo(3).reboot(arm.clock.now())
        with pytest.raises(SourceLost, match=r"joint 'joint3' \(ID 3\) was restarted"):
            read(arm, 100)
    with arm.joints:
        assert arm.error(read(arm)[0]) < 2 * TICK


# --- turns


def turning(t: float) -> float:
    return 10.0 * max(t - 100.0, 0.0)


@pytest.mark.parametrize(
    "model", ["MX-28", *(pytest.param(model, marks=pytest.mark.soak) for model in ("XM430-W350", "PH42-020-S300"))]
)
def test_positions_go_on_across_turns(model) -> None:
    with (arm := Arm((model,), [turning])).joints:
        for reading in read(arm, 600):
            assert arm.error(reading) < 10.0 * 0.6e-3 + TICK
    assert reading.q[0] > 3 * 2 * math.pi


def test_lost_turn_count_is_restored_from_last_pose() -> None:
    place = [0.0]
    arm = Arm(("XM430-W350",), [lambda t: place[0] + (9.0 if t > 50 else 0.0)])
    with arm.joints:
        before = read(arm)[0].q[0]
    arm.chain.power_cycle(arm.clock.now())
    place[0] = 0.2
    with arm.joints:
        assert before == pytest.approx(9.0, abs=TICK)
        assert read(arm)[0].q[0] == pytest.approx(9.2, abs=TICK)


def test_joint_with_ambiguous_turn_is_named() -> None:
    place = [9.0]
    arm = Arm(("XM430-W350",), [lambda t: place[0]], last_pose=[9.0])
    with arm.joints:
        read(arm)
    arm.chain.power_cycle(arm.clock.now())
    place[0] = 11.5
    with pytest.raises(SourceError, match=r"joint 'joint1' \(ID 1\) was at 516° and is now .* turn count is lost"):
        arm.joints.__enter__()
    place[0] = 9.3
    with arm.joints:
        assert read(arm)[0].q[0] == pytest.approx(9.3, abs=TICK)


def test_limits_within_a_turn_tell_the_turn() -> None:
    place = [2.0]
    arm = Arm(("XM430-W350",), [lambda t: place[0]], limits=[(0.5, 5.5)], last_pose=[0.6])
    arm.chain.power_cycle(0.0)
    place[0] = 4.0  # beyond the middle ± half a turn of the servo
    arm.chain.power_cycle(1.0)
    with arm.joints:
        assert read(arm)[0].q[0] == pytest.approx(4.0, abs=TICK)


# --- times, rates, storms


@pytest.mark.parametrize(
    ("fast", "delay_s"),
    [
        ("auto", 0.0),
        ("never", 500e-6),
        pytest.param("auto", 500e-6, marks=pytest.mark.soak),
        pytest.param("never", 0.0, marks=pytest.mark.soak),
    ],
)
def test_times_match_sampling_to_half_a_millisecond(fast, delay_s) -> None:
    with (arm := Arm(("XM430-W350",) * 6, latency_s=2e-3, delay_s=delay_s, fast=fast)).joints:
        off = [abs(reading.t - arm.sampled()) for reading in (read(arm)[0] for _ in range(300))]
    assert np.count_nonzero(np.array(off) >= 0.5e-3) <= 10  # at the beginning, while the delay is hardly known


@pytest.mark.parametrize(("model", "fast"), [("XM430-W350", "auto"), ("XM430-W350", "never"), ("MX-28", "never")])
@pytest.mark.parametrize("held_s", [0.0, 2e-3])
def test_reading_reports_its_time_uncertainty(model, fast, held_s) -> None:
    with (arm := Arm((model,) * 6, [lambda _: 0.5] * 6, latency_s=4e-3, held_s=held_s, fast=fast)).joints:
        for _ in range(50):
            reading = read(arm)[0]
            assert abs(reading.t - arm.sampled()) <= math.sqrt(3) * reading.t_sigma + 1e-6
            assert 0 <= reading.t_sigma < 4e-3


def test_six_servos_are_read_at_200_hz() -> None:
    with (arm := Arm(("XM430-W350",) * 6, fast="never")).joints:
        begin = arm.clock.now()
        read(arm, 200)
        assert 200 / (arm.clock.now() - begin) >= 200


@pytest.mark.parametrize(
    ("models", "fast"),
    [
        (("XM430-W350",) * 6, "auto"),
        (MIXED, "never"),
        pytest.param(("XM430-W350",) * 6, "never", marks=pytest.mark.soak),
        pytest.param(MIXED, "auto", marks=pytest.mark.soak),
    ],
)
def test_fault_storm_yields_no_wrong_reading(models, fast) -> None:
    arm = Arm(models, fast=fast, seed=5)
    with arm.joints:
        arm.chain.faults = storm(0.06, Random(6), swapped)
        readings = read(arm, 300)
    assert sum(arm.chain.faults.struck.values()) > 18
    assert max(arm.error(reading) for reading in readings) < 0.01
