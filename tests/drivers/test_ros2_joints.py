"""The joints of a ROS 2 robot, in virtual time."""

from __future__ import annotations

import logging
from random import Random

import numpy as np
import pytest
from ros2_robot import PATHS, Robot
from spoilt_messages import Fault

from bodyschema.drivers.ros2 import rmw
from bodyschema.drivers.ros2.emulator.node import Node
from bodyschema.drivers.ros2.link import Sample
from bodyschema.drivers.ros2.messages import JOINT_STATE, POINT_STAMPED, Header, JointState, encode_joint_state
from bodyschema.drivers.ros2.senders import Refusal
from bodyschema.interfaces.errors import SourceError, SourceLost

FASTEST = 1.2 * 0.7  # [rad/s]
CLOCKS = dict.fromkeys(PATHS, lambda t: t)  # joints whose position shows the time
# There is no checksum in the bytes, TCP's is all: another bit of a position is another position.
SEEN_BY_THE_GATE = (Fault.BIT, Fault.WORD, Fault.SWAPPED_NAMES)


def said(name: str, *joints: str, rate_hz: float = 100.0, **settings) -> Node:
    """Return a node that publishes some of the joints."""
    return Node({joint: PATHS[joint] for joint in joints}, rate_hz, name=name, **settings)


def sigma_of(robot: Robot) -> float:
    """Return the 1-sigma of the last time after 3 s [s]."""
    with robot.joints:
        return robot.read(3.0)[-1].t_sigma


# --- readings


def test_joints_follow_configured_order_and_stamp_time() -> None:
    robot = Robot()
    with robot.joints:
        readings = robot.read(1.005)
    assert len(readings) == 99  # the first message has to be confirmed
    assert max(map(robot.error, readings)) < 1e-9


def test_joints_may_have_other_names_in_ros() -> None:
    robot = Robot(joints=("pan", "tilt"), names={"tilt": "lift"})
    robot.paths["tilt"] = robot.paths["lift"]
    with robot.joints:
        assert max(map(robot.error, robot.read(0.5))) < 1e-9


def test_unconfigured_joints_are_ignored() -> None:
    robot = Robot(joints=("pan",))
    with robot.joints:
        assert {len(reading.q) for reading in robot.read(0.5)} == {1}


def test_a_sliding_joint_has_a_gate_in_metres() -> None:
    path = {"lift": lambda t: 5.0 * t}
    turning, sliding = (Robot(joints=("lift",), paths=path, prismatic=[k]) for k in (False, True))
    with turning.joints, sliding.joints:
        assert len(turning.read(0.055)) == 4
        assert sliding.read(0.055) == []


def test_delayed_messages_are_timed_by_their_stamps() -> None:
    rng = Random(3)
    robot = Robot(delay=lambda: 0.002 + rng.expovariate(500.0))
    with robot.joints:
        robot.read(2.0)
        worst = max(map(robot.error, robot.read(5.0)))
    assert worst < FASTEST * 0.003  # the quickest takes 2 ms, which is not observable


@pytest.mark.parametrize("delays_per_s", [100.0, 500.0, 2000.0])
def test_the_time_sigma_holds_from_the_first_reading(delays_per_s) -> None:
    rng = Random(3)
    robot = Robot(paths=CLOCKS, delay=lambda: rng.expovariate(delays_per_s))
    with robot.joints:
        readings = robot.read(20.0)
    assert max(abs(reading.t - reading.q[0]) - 3 * reading.t_sigma for reading in readings) < 0.0


def test_time_sigma_is_a_millisecond_on_quick_network() -> None:
    robot = Robot()
    with robot.joints:
        assert 0.1e-3 < robot.read(5.0)[-1].t_sigma < 1.5e-3


def test_time_sigma_grows_with_delay_scatter() -> None:
    rng = Random(3)
    robot = Robot(delay=lambda: rng.uniform(0.0, 0.02))
    with robot.joints:
        assert 5e-3 < robot.read(5.0)[-1].t_sigma < 15e-3


def test_least_certain_node_sets_the_time_sigma() -> None:
    slow, quick = (
        sigma_of(Robot([said("b", "elbow", rate_hz=rate_hz)], joints=("elbow",))) for rate_hz in (10.0, 100.0)
    )
    assert quick < 0.5 * slow
    for first, second in ((100.0, 10.0), (10.0, 100.0)):
        both = Robot([said("a", "pan", "lift", rate_hz=first), said("b", "elbow", rate_hz=second)])
        assert sigma_of(both) == pytest.approx(slow, rel=0.1)


@pytest.mark.parametrize("drift", [-1e-4, *(pytest.param(drift, marks=pytest.mark.soak) for drift in (1e-4, 2e-3))])
def test_a_clock_of_another_rate_is_followed(drift) -> None:
    rng = Random(4)
    robot = Robot([said("a", *PATHS, rate_hz=10.0, drift=drift)], delay=lambda: rng.uniform(0.0, 1e-3))
    with robot.joints:
        readings = robot.read(150.0)
    assert len(readings) >= 1490
    assert max(map(robot.error, readings)) < FASTEST * 0.003


def test_reading_keeps_the_robot_s_own_stamp() -> None:
    robot = Robot()
    with robot.joints:
        reading = robot.read(0.1)[-1]
    assert robot.joints.stamp_ns == robot.nodes[0].stamp_ns(reading.t)


# --- joints of several nodes


def test_joints_of_several_nodes_share_one_time() -> None:
    robot = Robot([said("a", "pan", "lift"), said("b", "elbow", rate_hz=31.0)])
    with robot.joints:
        readings = robot.read(5.0)
    assert len(readings) > 150
    assert max(map(robot.error, readings)) < 1.2 * 0.7**2 * 0.033**2 / 8 + 1e-9  # of a chord


def test_nodes_may_have_clocks_of_their_own() -> None:
    robot = Robot([said("a", "pan", "lift"), said("b", "elbow", rate_hz=50.0)])
    robot.nodes[1].set_by_s = -12345.0
    with robot.joints:
        assert max(map(robot.error, robot.read(2.0))) < 1e-3


def test_positions_far_apart_in_time_are_not_merged() -> None:
    robot = Robot([said("a", "pan", "lift"), said("b", "elbow", rate_hz=3.0)])
    with robot.joints:
        readings = robot.read(3.0)
    assert max(map(robot.error, readings)) < 1e-5
    assert robot.joints.refused[Refusal.GAP] > 0


def test_first_node_wins_for_a_shared_joint() -> None:
    other = Node({"pan": lambda t: 0.0}, 100.0, name="gui")
    robot = Robot([said("a", *PATHS), other])
    with robot.joints:
        assert max(map(robot.error, robot.read(1.0))) < 1e-9
    assert robot.joints.refused[Refusal.RIVAL] > 90


def test_restarted_node_is_accepted_after_a_second() -> None:
    robot = Robot([said("a", *PATHS)])
    with robot.joints:
        robot.read(1.0)
        robot.link._nodes[0] = said("restarted", *PATHS)
        assert 90 <= len(robot.read(2.0)) <= 110


# --- refusals


@pytest.mark.parametrize(
    ("fault", "reasons"),
    [
        (Fault.GARBAGE, {Refusal.MALFORMED}),
        (Fault.TRUNCATED, {Refusal.MALFORMED}),
        (Fault.SWAPPED_NAMES, {Refusal.TOO_FAST}),
        (Fault.NAN, {Refusal.NOT_FINITE}),
        (Fault.REPEATED, {Refusal.DUPLICATE}),
        (Fault.CLOCK_JUMP, {Refusal.DELAYED, Refusal.OUT_OF_ORDER}),
    ],
)
def test_faulty_message_is_counted_and_costs_only_itself(fault, reasons) -> None:
    robot = Robot()
    with robot.joints:
        robot.read(1.005)
        robot.faults.next = fault
        readings = robot.read(1.0)
    assert len(readings) == 99
    assert max(map(robot.error, readings)) < 1e-9
    assert sum(robot.joints.refused.values()) == 1
    assert set(robot.joints.refused) <= reasons


def test_message_missing_a_joint_costs_only_itself() -> None:
    robot = Robot()
    with robot.joints:
        robot.read(1.005)
        robot.faults.next = Fault.MISSING_JOINT
        readings = robot.read(1.0)
    assert len(readings) >= 99
    assert max(map(robot.error, readings)) < FASTEST * 0.01


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 3))])
def test_mixed_faults_yield_no_wrong_reading(seed) -> None:
    kinds = tuple(fault for fault in Fault if fault not in SEEN_BY_THE_GATE)
    robot = Robot(share=0.2, kinds=kinds, seed=seed)
    with robot.joints:
        robot.read(2.0)  # where the first stamp is wrong, this shows within a second
        readings = robot.read(20.0)
    assert max(map(robot.error, readings)) < FASTEST * 0.011  # a stamp may be wrong by a period unseen
    assert len(readings) > 1430
    assert len(robot.faults.given) == len(kinds)


@pytest.mark.parametrize("kind", SEEN_BY_THE_GATE)
def test_speed_gate_bounds_error_of_otherwise_undetected_faults(kind) -> None:
    robot = Robot(share=0.2, kinds=(kind,))
    with robot.joints:
        readings = robot.read(10.0)
    gaps = np.diff([reading.t for reading in readings])
    assert max(map(robot.error, readings)) < (np.radians(600.0) + FASTEST) * gaps.max() + 0.02
    assert len(readings) > 660


def test_stamps_that_are_zero_are_refused() -> None:
    robot = Robot([])
    robot.link.receive = feed(robot, [JointState(Header(0), ("elbow", "pan", "lift"), (0.0, 0.0, 0.0))])
    with robot.joints:
        assert robot.joints.read(0.1) is None
    assert robot.joints.refused == {Refusal.NO_STAMP: 1}


@pytest.mark.parametrize(
    ("names", "positions", "reason"),
    [(("pan", "pan"), (0.0, 1.0), Refusal.TWICE), (("pan",), (), Refusal.NO_POSITIONS)],
)
def test_ambiguous_or_missing_positions_are_refused(names, positions, reason) -> None:
    robot = Robot([], joints=("pan",))
    robot.link.receive = feed(robot, [JointState(Header(5), names, positions)])
    with robot.joints:
        assert robot.joints.read(0.1) is None
    assert robot.joints.refused == {reason: 1}


def feed(robot: Robot, messages: list[JointState]):
    """Replace a link's `receive` by these messages, and then nothing."""

    def receive(until: float) -> Sample | None:
        robot.clock.wait_until(min(until, robot.clock.now() + 0.01) if messages else until)
        return Sample(encode_joint_state(messages.pop(0)), b"", robot.clock.now()) if messages else None

    return receive


def test_each_refusal_reason_is_reported_once(caplog) -> None:
    robot = Robot(share=0.5, kinds=(Fault.NAN,))
    with robot.joints, caplog.at_level(logging.WARNING):
        robot.read(5.0)
    assert len([record for record in caplog.records if "not finite" in record.message]) == 1


def test_messages_that_never_came_are_counted() -> None:
    robot = Robot()
    with robot.joints:
        robot.read(1.0)
        for _ in range(7):
            robot.nodes[0].at(robot.clock.now())
        robot.read(1.0)
    assert robot.joints.lost == 7


def test_any_number_of_strangers_costs_bounded_memory() -> None:
    robot = Robot([], joints=("pan",))
    robot.link.receive = feed(robot, [JointState(Header(5), (f"joint{k}",), (0.0,)) for k in range(500)])
    with robot.joints:
        assert robot.joints.read(6.0) is None
        assert len(robot.joints._senders) <= 64


# --- events on the robot


@pytest.mark.parametrize("seconds", [-3600.0, -7.0, 0.5, 3600.0])
def test_clock_change_is_learnt_within_about_a_second(seconds) -> None:
    robot = Robot()
    with robot.joints:
        robot.read(1.0)
        robot.nodes[0].set_by_s = seconds
        robot.read(1.005)
        readings = robot.read(1.0)
    assert len(readings) == 100
    assert max(map(robot.error, readings)) < 1e-6


def test_small_backward_clock_step_costs_ten_seconds() -> None:
    robot = Robot()
    with robot.joints:
        robot.read(1.0)
        robot.nodes[0].set_by_s = -0.5
        assert robot.read(9.0) == []
        robot.read(2.005)
        readings = robot.read(1.0)
    assert len(readings) == 100
    assert max(map(robot.error, readings)) < 1e-6


def test_stalled_network_gives_no_wrong_times_and_recovers() -> None:
    robot, begin = Robot(), 100.0
    robot.link._delay = lambda: max(0.0, 2.0 - (robot.link._due[0][0] - begin - 3.0)) if stalled(robot, begin) else 0.0
    with robot.joints:
        readings = robot.read(10.0)
    assert max(map(robot.error, readings)) < FASTEST * 0.002
    assert 780 <= len(readings) <= 860  # of two seconds' messages those that came within 0.1 s of their time
    assert set(robot.joints.refused) == {Refusal.DELAYED}


def test_stuttering_network_does_not_shift_the_time() -> None:
    rng = Random(5)
    robot = Robot(delay=lambda: rng.choice((0.0,) * 30 + (0.08, 0.0995, 0.1, 0.1005, 0.15)))
    with robot.joints:
        readings = robot.read(12.0)
    assert max(map(robot.error, readings)) < FASTEST * 0.002
    assert len(readings) > 800


def stalled(robot: Robot, begin: float) -> bool:
    return 3.0 <= robot.link._due[0][0] - begin < 5.0


def test_sudden_joint_jump_is_a_loss() -> None:
    robot = Robot(paths=PATHS | {"pan": lambda t: 0.0 if t < 101.0 else 2.0})
    with robot.joints, pytest.raises(SourceLost, match="suddenly somewhere else"):
        robot.read(2.0)
    with robot.joints:
        assert robot.read(1.0)[-1].q[1] == 2.0


def test_without_a_router_the_source_is_lost() -> None:
    robot = Robot()
    with robot.joints:
        robot.read(0.5)
        robot.link.is_connected = False
        with pytest.raises(SourceLost, match="is gone"):
            robot.joints.read(0.1)


def test_a_robot_that_falls_silent_is_waited_for() -> None:
    robot = Robot(share=1.0, kinds=(Fault.SILENCE,))
    with robot.joints:
        assert robot.read(10.005) == []
        robot.faults._share = 0.0
        assert len(robot.read(1.0)) == 99
    assert robot.joints.health == ()


def test_reading_an_unopened_source_is_an_error() -> None:
    with pytest.raises(SourceError):
        Robot().joints.read(0.1)


# --- why nothing comes


def complaint(robot: Robot) -> str:
    with robot.joints:
        robot.read(3.0)
        return "; ".join(robot.joints.health)


def test_missing_joint_complaint_lists_published_names() -> None:
    said_of_it = complaint(Robot(joints=("pan", "tilt")))
    assert "does not name tilt; it names elbow, lift, pan" in said_of_it


def test_complaint_names_the_fault_of_all_messages() -> None:
    assert "not finite" in complaint(Robot(share=1.0, kinds=(Fault.NAN,)))


@pytest.mark.parametrize(
    ("token", "says"),
    [
        (rmw.publisher_token(0, "z", "n", "/joint_states", JOINT_STATE), "says nothing"),
        (rmw.publisher_token(0, "z", "n", "/joint_states", POINT_STAMPED), "no topic of sensor_msgs/JointState"),
        (rmw.publisher_token(5, "z", "n", "/joint_states", JOINT_STATE), "in the domain 5, not 0"),
        (rmw.publisher_token(0, "z", "n", "/arm/joint_states", JOINT_STATE), "joint states on /arm/joint_states"),
        ("", "nothing publishes /joint_states at the router"),
    ],
)
def test_silence_complaint_names_topics_known_to_router(token, says) -> None:
    robot = Robot([])
    robot.link.known = [token]
    assert says in complaint(robot)


def test_times_strictly_increase_whatever_the_delays() -> None:
    rng = Random(7)
    robot = Robot(delay=lambda: rng.expovariate(100.0))
    with robot.joints:
        readings = robot.read(20.0)
    assert (np.diff([reading.t for reading in readings]) > 0).all()
    assert len(readings) >= 1980
