"""Invariants of guard and currents for arbitrary numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.drivers.dynamixel.guard import Currents, Drop, Guard, GuardLimits, Motion, ServoState
from bodyschema.interfaces.records import frozen_array

JOINTS = ("a", "b")
SPEED, CURRENT, HEARTBEAT_S, DOUBTS = 1.5, 1.0, 0.1, 10
WELL = ServoState(has_torque=True, trouble="", watchdog=5, took_goal=True, temperature_c=40.0)
numbers = st.floats(allow_nan=True, allow_infinity=True)
pairs = st.tuples(numbers, numbers)


def guard() -> Guard:
    two = np.ones(2)
    return Guard(GuardLimits(JOINTS, HEARTBEAT_S, SPEED * two, CURRENT * two, 65.0))


def currents() -> Currents:
    return Currents(JOINTS, np.array([1.5, 2.0]), np.array([CURRENT, 0.5]), 1.0)


def motion(t: float, q=(0.0, 0.0), velocity=(0.0, 0.0), current=(0.0, 0.0), alert=(False, False)) -> Motion:
    return Motion(t, np.array(q), np.array(velocity), np.array(current), alert)


def is_dropped(guard: Guard, now: float, what: Motion | None) -> bool:
    try:
        guard.check(now, what)
    except Drop:
        return True
    return False


def test_nothing_is_allowed_before_it_was_begun() -> None:
    assert is_dropped(guard(), 0.0, motion(0.0))


def test_an_arm_that_stands_still_is_left_alone() -> None:
    (well := guard()).begin(0.0)
    assert not any(is_dropped(well, k * 0.004, motion(k * 0.004)) for k in range(1, 1000))


@given(st.lists(st.tuples(st.floats(-0.01, 0.2), st.one_of(st.none(), st.tuples(pairs, pairs, pairs))), max_size=30))
def test_once_dropped_it_stays_dropped_whatever_comes(cycles) -> None:
    (watching := guard()).begin(0.0)
    now, was = 0.0, False
    for dt, told in cycles:
        now += dt
        dropped = is_dropped(watching, now, None if told is None else motion(now, *told))
        assert dropped or not was
        was = dropped
    if was:
        assert is_dropped(watching, now + 0.001, motion(now))
        watching.begin(now)
        assert not is_dropped(watching, now + 0.001, motion(now))


@given(pairs, pairs, pairs)
def test_only_finite_and_slow_motion_passes(q, velocity, current) -> None:
    (watching := guard()).begin(0.0)
    passed = not is_dropped(watching, 0.004, motion(0.004, q, velocity, current))
    allowed = np.isfinite([*q, *velocity, *current]).all() and np.abs(velocity).max() <= SPEED
    assert passed == bool(allowed)


@given(st.floats(0.021, 1.0), st.floats(-20, 20))
def test_speed_limit_also_applies_to_position_differences(dt, speed) -> None:
    (watching := guard()).begin(0.0)
    watching.check(0.001, motion(1.0))
    too_fast = abs(speed * dt) / dt > SPEED
    end = 1.0 + dt
    assert is_dropped(watching, 0.002, motion(end, (speed * (end - 1.0), 0.0))) == too_fast


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_it_is_let_pass_only_in_time(dt) -> None:
    (watching := guard()).begin(0.0)
    assert is_dropped(watching, dt, motion(0.0)) == (not 0 <= dt <= HEARTBEAT_S)


def test_guard_drops_after_too_many_doubtful_readings() -> None:
    (watching := guard()).begin(0.0)
    assert [is_dropped(watching, k * 0.01, None) for k in range(1, DOUBTS + 1)] == [False] * (DOUBTS - 1) + [True]


def test_accepted_reading_resets_the_doubt_count() -> None:
    (watching := guard()).begin(0.0)
    told = [None] * (DOUBTS - 1) + [motion(0.0)] + [None] * (DOUBTS - 1)
    assert not any(is_dropped(watching, k * 0.01, each) for k, each in enumerate(told, 1))


@pytest.mark.parametrize(
    "state",
    [
        {"has_torque": False},
        {"trouble": "it is too hot"},
        {"watchdog": -1},
        {"watchdog": 0},
        {"temperature_c": 65.0},
        {"temperature_c": math.nan},
    ],
)
def test_a_servo_that_is_not_well_ends_it(state) -> None:
    (watching := guard()).begin(0.0)
    watching.check_servo("a", WELL)
    told = {field: getattr(WELL, field) for field in ServoState.__dataclass_fields__}
    with pytest.raises(Drop):
        watching.check_servo("a", ServoState(**{**told, **state}))
    assert is_dropped(watching, 0.01, motion(0.0))


def test_an_alert_ends_it() -> None:
    (watching := guard()).begin(0.0)
    assert is_dropped(watching, 0.01, motion(0.0, alert=(False, True)))


def test_only_sustained_overcurrent_is_dropped() -> None:
    (watching := guard()).begin(0.0)
    times = [k * 0.05 for k in range(1, 20)]
    first = next(t for t in times if is_dropped(watching, t, motion(t, current=(0.0, 1.3))))
    assert first == pytest.approx(times[0] + 0.5, abs=0.051)


@given(st.floats(0, 3), st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)))
def test_current_stays_within_limit_and_ramp(after_s, torques) -> None:
    (law := currents()).begin(10.0)
    found = law.at(10.0 + after_s, np.array(torques))
    assert (np.abs(found) <= [CURRENT, 0.5]).all()
    ramp = min(after_s, 1.0) + 1e-9
    assert (np.abs(found) <= ramp * np.abs(torques) / [1.5, 2.0] + 1e-12).all()
    assert ((found == 0) | (np.sign(found) == np.sign(torques))).all()


@given(st.floats(-1e6, 10.0))
def test_before_the_beginning_there_is_no_current(now) -> None:
    (law := currents()).begin(10.0)
    assert not law.at(now, np.ones(2)).any()
    assert not currents().at(now, np.ones(2)).any()


@given(st.integers(0, 1), st.sampled_from([math.nan, math.inf, -math.inf]))
def test_non_finite_torque_gives_no_current(place, wrong) -> None:
    (law := currents()).begin(0.0)
    torques = np.ones(2)
    torques[place] = wrong
    with pytest.raises(Drop):
        law.at(5.0, torques)


def test_wrong_number_of_torques_gives_no_current() -> None:
    with pytest.raises(Drop):
        currents().at(5.0, frozen_array([1.0]))


def test_joints_at_their_limit_are_named() -> None:
    (law := currents()).begin(0.0)
    law.at(5.0, np.array([1.0, 1.5]))
    assert law.saturated == ("b",)
