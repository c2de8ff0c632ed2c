"""The Feetech driver on its emulator, in virtual time."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from random import Random

import numpy as np
import pytest
from feetech_arm import FeetechArm
from hypothesis import given
from hypothesis import strategies as st
from servo_arm import TICK, swing
from wire_faults import storm

from bodyschema.drivers.emulator.faults import corrupt, garbage, half, late, mute, wrong_checksum
from bodyschema.drivers.feetech.emulator.arm import swapped
from bodyschema.drivers.feetech.emulator.servo import Servo
from bodyschema.drivers.feetech.models import BY_NAME
from bodyschema.drivers.servos.channel import Punctuality
from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.records import JointReading

FAULTS = [mute, late(0.02), wrong_checksum, corrupt(), half, garbage, swapped]
MIXED = ("STS3215", "SCS0009", "STS3250", "SM8512BL")


def read(arm: FeetechArm, count: int = 1) -> list[JointReading]:
    found = []
    while len(found) < count:
        reading = arm.joints.read(0.1)
        if reading is not None:
            found.append(reading)
    return found


@pytest.mark.parametrize("models", [("STS3215",) * 6, MIXED])
@pytest.mark.parametrize("sync", ["auto", "never"])
def test_reading_matches_each_joint_angle_when_sampled(models, sync) -> None:
    with (arm := FeetechArm(models, sync=sync)).joints:
        for _ in range(50):
            reading = read(arm)[0]
            for q, servo in zip(reading.q, arm.chain.servos, strict=True):
                assert abs(q - arm.chain.samplings[servo.id].angle) <= servo.model.rad_per_tick / 2 + 1e-12


def test_tick_is_exact_for_sts_and_scs_series() -> None:
    scs = math.radians(300) / 1024
    with (arm := FeetechArm(("STS3215", "SCS0009"), [lambda t: 1000 * TICK, lambda t: -100 * scs])).joints:
        assert read(arm)[0].q.tolist() == [1000 * TICK, -100 * scs]


@pytest.mark.parametrize(("knows", "code"), [(True, 0x82), (False, 0x02)])
def test_sync_read_is_used_where_all_know_it(knows, code) -> None:
    arm = FeetechArm()
    arm.chain.servo(2).knows_sync_read = knows
    with arm.joints:
        read(arm)
        arm.port.heard.clear()
        read(arm)
    assert arm.port.heard[0].code == code


def test_speed_and_current_keep_their_signs() -> None:
    arm = FeetechArm(("STS3215",), [lambda t: -0.5 * t % 6.0])
    arm.chain.servo(1)["current"] = -20
    with arm.joints:
        read(arm, 10)
        sample = arm.joints.samples["joint1"]
    assert sample is not None
    assert sample.velocity == pytest.approx(-0.5, abs=2 * TICK)
    assert sample.current == pytest.approx(-20 * 6.5e-3)


# --- torque and settings


def test_torque_is_off_before_readings_and_stays_off() -> None:
    arm = FeetechArm(MIXED)
    arm.chain.servo(2)["torque"] = 1
    with arm.joints:
        assert [servo["torque"] for servo in arm.chain.servos] == [0] * 4
        read(arm, 100)
    assert arm.port.writes() == [(40, b"\x00")]


def test_nothing_is_written_where_nothing_needs_to_be() -> None:
    with (arm := FeetechArm(MIXED)).joints:
        read(arm, 100)
    assert arm.port.writes() == []


def test_torque_off_succeeds_without_write_answers() -> None:
    arm = FeetechArm()
    arm.chain.servo(1)["status_return"] = 0
    arm.chain.servo(1)["torque"] = 1
    with arm.joints:
        assert arm.chain.servo(1)["torque"] == 0


def test_torque_that_is_switched_on_meanwhile_is_found() -> None:
    arm = FeetechArm()
    with arm.joints:
        read(arm)
        arm.chain.servo(3)["torque"] = 1
        with pytest.raises(SourceLost, match="torque of joint 'joint3' was switched on by another program"):
            read(arm, 1000)


def test_torque_is_restored_where_on_if_requested() -> None:
    arm = FeetechArm(("STS3215", "SCS0009"), restore_torque=True)
    arm.chain.servo(2)["torque"] = 1
    with arm.joints:
        read(arm)
    assert [servo["torque"] for servo in arm.chain.servos] == [0, 1]
    assert abs(arm.chain.servo(2)["goal"] - arm.chain.servo(2).position(arm.clock.now())) <= 3


def test_record_holds_the_settings_of_each_servo() -> None:
    arm = FeetechArm()
    arm.chain.servo(1)["homing_offset"] = -17
    with arm.joints:
        kept, version = arm.joints.record[0], arm.joints.servos[0].version
    assert (kept["model"], kept["firmware"], kept["homing_offset_ticks"]) == ("STS3215", 0x030A, -17)
    assert version == "3.10"


# --- servos present


def test_missing_and_wrong_servos_share_one_table() -> None:
    arm = FeetechArm()
    arm.chain.servos[1:] = [Servo(BY_NAME["STS3250"], 3, swing(0))]
    with pytest.raises(SourceError) as refusal, arm.joints:
        pass
    assert str(refusal.value).splitlines()[:-1] == [
        "the servos on emulator are not those of robot.toml:",
        "  joint   ID  expected  found",
        "  joint1  1   STS3215   STS3215",
        "  joint2  2   STS3215   no answer",
        "  joint3  3   STS3215   STS3250: wrong model",
    ]


def test_two_servos_of_one_id_are_refused() -> None:
    arm = FeetechArm()
    arm.chain.servos.append(Servo(BY_NAME["STS3250"], 2, swing(9), return_delay_s=0))
    with pytest.raises(SourceError, match=r"joint2 .* two servos with this ID"), arm.joints:
        pass


def test_a_servo_at_another_rate_does_not_answer() -> None:
    arm = FeetechArm()
    arm.chain.servo(1)["baud"] = 4
    with pytest.raises(SourceLost, match=r"joint1 .* no answer"), arm.joints:
        pass


# --- faults


@pytest.mark.parametrize("fault", FAULTS, ids=range(len(FAULTS)))
@pytest.mark.parametrize("sync", ["auto", "never"])
def test_a_fault_costs_a_reading_and_nothing_else(fault, sync) -> None:
    with (arm := FeetechArm(MIXED, sync=sync)).joints:
        read(arm, 10)
        for id in range(1, 5):
            arm.faults.add(id, fault, 1)
            assert max(arm.error(reading) for reading in read(arm, 20)) < 3e-3 + math.radians(300) / 1024
    assert arm.joints.epoch == 1


def test_error_flag_keeps_readings_and_reports_the_remedy(caplog) -> None:
    with caplog.at_level(logging.WARNING), (arm := FeetechArm()).joints:
        arm.chain.servo(2).fail(0x20)
        assert max(arm.error(reading) for reading in read(arm, 200)) < 2 * TICK
        assert arm.joints.health == (
            "joint 'joint2': it is overloaded: free the joint, then switch its supply off and on",
        )
        assert len(caplog.messages) == 1


def test_mute_servo_does_not_discard_other_answers() -> None:
    with (arm := FeetechArm()).joints:
        read(arm)
        arm.faults.add(3, mute)
        before = arm.joints.samples["joint1"]
        assert arm.joints.read(0.02) is None
        assert arm.joints.samples["joint1"] is not before


def test_a_servo_that_stays_mute_is_named() -> None:
    arm = FeetechArm()
    with arm.joints:
        read(arm)
        arm.chain.servos.pop(1)
        with pytest.raises(SourceLost, match=r"joint 'joint2' \(ID 2\): no answer"):
            read(arm, 1000)


def test_an_encoder_s_glitch_is_not_believed() -> None:
    with (arm := FeetechArm()).joints:
        read(arm)
        arm.chain.servo(2).glitch_ticks = 300
        assert arm.joints.read(0.008) is None
        arm.chain.servo(2).glitch_ticks = 0
        assert max(arm.error(reading) for reading in read(arm, 20)) < 2 * TICK


@pytest.mark.parametrize("sync", ["auto", "never"])
def test_fault_storm_yields_no_wrong_reading(sync) -> None:
    arm = FeetechArm(("STS3215",) * 6, sync=sync, seed=5)
    with arm.joints:
        arm.chain.faults = struck = storm(0.04, Random(6), swapped)
        readings = read(arm, 300)
    assert arm.chain.instructions > 300
    assert sum(struck.struck.values()) > 18
    assert max(arm.error(reading) for reading in readings) < 0.01


# --- turns, times, rates


@pytest.mark.parametrize("multi_turn", [False, True])
def test_positions_go_on_across_turns(multi_turn) -> None:
    with (arm := FeetechArm(("STS3215",), [lambda t: 10.0 * (t - 100.0)], multi_turn=multi_turn)).joints:
        readings = read(arm, 600)
    assert max(arm.error(reading) for reading in readings) < 10.0 * 0.6e-3 + TICK
    assert readings[-1].q[0] > 3 * 2 * math.pi


def test_lost_turn_count_is_restored_from_last_pose() -> None:
    place = [9.0]
    arm = FeetechArm(("STS3215",), [lambda t: place[0]], last_pose=[9.1])
    arm.chain.power_cycle(arm.clock.now())
    with arm.joints:
        assert read(arm)[0].q[0] == pytest.approx(9.0, abs=TICK)
    place[0] = 11.5
    with pytest.raises(SourceError, match=r"joint 'joint1' .* turn count is lost"):
        arm.joints.__enter__()


def test_times_match_sampling_to_half_a_millisecond() -> None:
    with (arm := FeetechArm(("STS3215",) * 6, latency_s=1e-3)).joints:
        off = [abs(reading.t - arm.sampled()) for reading in (read(arm)[0] for _ in range(300))]
    assert np.percentile(off, 99) < 0.5e-3


@pytest.mark.parametrize(("model", "sync"), [("STS3215", "auto"), ("STS3215", "never"), ("SCS0009", "never")])
@pytest.mark.parametrize("held_s", [0.0, 2e-3])
def test_reading_reports_its_time_uncertainty(model, sync, held_s) -> None:
    with (arm := FeetechArm((model,) * 6, [lambda _: 0.5] * 6, latency_s=4e-3, held_s=held_s, sync=sync)).joints:
        for _ in range(50):
            reading = read(arm)[0]
            assert abs(reading.t - arm.sampled()) <= math.sqrt(3) * reading.t_sigma + 1e-6
            assert 0 <= reading.t_sigma < 4e-3
        assert reading.t_sigma > 1e-5


def test_delayed_reading_without_servo_clock_is_dropped() -> None:
    with (arm := FeetechArm(("STS3215",) * 6)).joints:
        read(arm, 60)
        arm.faults.add(1, lambda reply, _: replace(reply, start=reply.start + 2e-3), 1)
        dropped = arm.joints.dropped
        read(arm, 5)
        assert arm.joints.dropped == dropped + 1


@given(st.lists(st.floats(0, 8e-3), min_size=60, max_size=200))
def test_most_readings_of_a_delaying_adapter_are_kept(unsure) -> None:
    punctuality = Punctuality()
    kept = [punctuality.is_usual(width) for width in unsure]
    assert sum(kept) >= len(kept) // 2 - 1


def test_six_servos_are_read_at_200_hz() -> None:
    with (arm := FeetechArm(("STS3215",) * 6)).joints:
        begin = arm.clock.now()
        read(arm, 200)
        assert 200 / (arm.clock.now() - begin) >= 200
