from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Event

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.daemon.sampler.align import JointBuffer, joint_difference
from bodyschema.interfaces.records import JointReading, Reason, frozen_array

LIMIT_S = 500.0
REVOLUTE = np.array([False, False])


def reading(t: float, *q: float) -> JointReading:
    return JointReading(t, frozen_array(q))


@pytest.fixture
def buffer() -> JointBuffer:
    return JointBuffer(REVOLUTE, max_gap_s=0.1)


@given(fraction=st.floats(0.01, 0.99), start=st.floats(-3, 3), rate=st.floats(-5, 5))
def test_constant_velocity_joint_is_interpolated_exactly(fraction, start, rate) -> None:
    buffer = JointBuffer(REVOLUTE, max_gap_s=0.1)
    for step in range(4):
        t = 10 + 0.05 * step
        buffer.put(reading(t, start + rate * t, 0.0))
    t = 10.05 + 0.05 * fraction
    assert buffer.at(t, 0.0)[0] == pytest.approx(start + rate * t, abs=1e-12)


def test_frame_at_reading_time_gets_that_reading(buffer) -> None:
    readings = [reading(0.0, 0.1, 0.2), reading(0.01, 0.3, 0.7), reading(0.02, 0.5, 0.9)]
    for each in readings:
        buffer.put(each)
    assert [buffer.at(each.t, 0.0) is each.q for each in readings] == [True, True, True]


def test_frame_at_reading_time_needs_no_neighbouring_reading(buffer) -> None:
    buffer.put(reading(0.0, 1.0, 1.0))
    buffer.put(reading(5.0, 2.0, 2.0))
    assert buffer.at(5.0, 0.0).tolist() == [2.0, 2.0]


def test_readings_too_far_apart_are_stale(buffer) -> None:
    buffer.put(reading(0.0, 1.0, 1.0))
    buffer.put(reading(0.11, 2.0, 2.0))
    assert buffer.at(0.05, 0.0) is Reason.STALE


@pytest.mark.parametrize(("t_sigma", "time_uncertainty_motion"), [(0.0, 0.0), (0.002, 0.02)])
def test_slack_is_speed_times_time_sigma(buffer, t_sigma, time_uncertainty_motion) -> None:
    buffer.put(JointReading(0.0, frozen_array([0.0, 1.0]), t_sigma))
    buffer.put(JointReading(0.01, frozen_array([0.1, 1.0])))
    assert buffer.time_uncertainty_motion(0.005).tolist() == pytest.approx([time_uncertainty_motion, 0.0])


def test_a_frame_before_all_readings_has_no_joints(buffer) -> None:
    buffer.put(reading(1.0, 1.0, 1.0))
    buffer.put(reading(1.01, 1.0, 1.0))
    assert buffer.at(0.5, 0.0) is Reason.NO_JOINTS


def test_frame_without_later_reading_has_no_joints(buffer) -> None:
    buffer.put(reading(1.0, 1.0, 1.0))
    assert buffer.at(1.05, 0.01) is Reason.NO_JOINTS


@contextmanager
def waited_on(buffer: JointBuffer) -> Iterator[Event]:
    """Yield an event that is set when a thread is about to wait and holds the buffer's lock until it does."""
    begun, wait_for = Event(), buffer._changed.wait_for

    def telling(predicate: Callable[[], bool], timeout_s: float | None = None) -> bool:
        begun.set()
        return wait_for(predicate, timeout_s)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(buffer._changed, "wait_for", telling)
        yield begun


def test_a_frame_waits_for_the_reading_after_it(buffer) -> None:
    buffer.put(reading(1.0, 1.0, 1.0))
    with ThreadPoolExecutor() as pool, waited_on(buffer) as begun:
        waiting = pool.submit(buffer.at, 1.05, LIMIT_S)
        assert begun.wait(LIMIT_S)
        buffer.put(reading(1.1, 3.0, 1.0))
        assert waiting.result(LIMIT_S).tolist() == pytest.approx([2.0, 1.0])


def test_lost_encoders_keep_no_frame_waiting(buffer) -> None:
    buffer.put(reading(1.0, 1.0, 1.0))
    buffer.expect_no_readings()
    assert buffer.at(1.05, 3600.0) is Reason.NO_JOINTS


def test_the_first_reading_ends_the_silence(buffer) -> None:
    buffer.expect_no_readings()
    buffer.put(reading(1.0, 1.0, 1.0))
    with ThreadPoolExecutor() as pool, waited_on(buffer) as begun:
        waiting = pool.submit(buffer.at, 1.05, LIMIT_S)
        assert begun.wait(LIMIT_S)
        buffer.put(reading(1.06, 1.0, 1.0))
        assert not isinstance(waiting.result(LIMIT_S), Reason)


def test_encoders_that_run_ahead_wait_for_the_frames() -> None:
    buffer = JointBuffer(REVOLUTE, max_gap_s=1.0, capacity=4)
    times = np.arange(200) * 0.01
    with ThreadPoolExecutor() as pool:
        done = pool.submit(lambda: [buffer.put(reading(t, t, 2 * t)) for t in times])
        found = np.array([buffer.at(t, LIMIT_S) for t in times])
        done.result(LIMIT_S)
    assert np.array_equal(found[:, 0], times)


def test_skipped_frames_make_room_for_encoder_readings() -> None:
    buffer = JointBuffer(REVOLUTE, max_gap_s=1.0, capacity=4)
    for i in range(40):
        buffer.put(reading(float(i), 0.0, 0.0))
        buffer.forget_before(float(i))
    assert buffer.at(39.0, 0.0).tolist() == [0.0, 0.0]


def test_encoders_without_cameras_keep_the_newest_readings() -> None:
    buffer = JointBuffer(REVOLUTE, max_gap_s=1.0, capacity=4)
    for i in range(40):
        buffer.make_room()
        buffer.put(reading(float(i), float(i), 0.0))
    assert buffer.at(39.0, 0.0)[0] == 39.0


def test_closing_lets_waiting_encoders_go() -> None:
    buffer = JointBuffer(REVOLUTE, max_gap_s=1.0, capacity=1)
    buffer.put(reading(0.0, 0.0, 0.0))
    with ThreadPoolExecutor() as pool, waited_on(buffer) as begun:
        waiting = pool.submit(buffer.put, reading(1.0, 0.0, 0.0))
        assert begun.wait(LIMIT_S)
        buffer.close()
        waiting.result(LIMIT_S)
    assert buffer.at(1.0, 0.0) is Reason.NO_JOINTS


def test_revolute_interpolation_takes_short_way_across_wrap() -> None:
    buffer = JointBuffer(REVOLUTE, max_gap_s=0.1)
    buffer.put(reading(0.0, np.pi - 0.01, 0.0))
    buffer.put(reading(0.1, -np.pi + 0.01, 0.0))
    angle = buffer.at(0.05, 0.0)[0]
    assert np.cos(angle) == pytest.approx(-1.0, abs=1e-12)


def test_prismatic_difference_does_not_wrap() -> None:
    far = joint_difference(np.array([4.0, 4.0]), np.array([0.0, 0.0]), np.array([True, False]))
    assert far.tolist() == pytest.approx([4.0, 4.0 - 2 * np.pi])


@given(st.lists(st.floats(-50, 50), min_size=2, max_size=2))
def test_revolute_difference_never_exceeds_half_a_turn(angles) -> None:
    difference = joint_difference(np.array(angles), np.zeros(2), REVOLUTE)
    assert (np.abs(difference) <= np.pi + 1e-12).all()


def test_live_encoders_drop_oldest_readings_instead_of_waiting() -> None:
    buffer = JointBuffer(REVOLUTE, max_gap_s=0.1, capacity=10, live=True)
    for step in range(100):
        buffer.put(reading(0.01 * step, 0.0, 0.0))  # not live, the eleventh would wait forever
    assert buffer.at(0.5, 0.0) is Reason.NO_JOINTS
    assert not isinstance(buffer.at(0.95, 0.0), Reason)


@given(rate=st.floats(-5, 5), during_s=st.floats(0.001, 0.3))
def test_displacement_covers_time_uncertainty_beyond_kept_readings(rate, during_s) -> None:
    buffer = JointBuffer(REVOLUTE, max_gap_s=0.1, kept_s=0.1)
    for step in range(60):
        buffer.put(reading(0.01 * step, rate * 0.01 * step, 0.0))
    moved = buffer.moved(0.3, during_s, 0.0)
    assert not isinstance(moved, Reason)
    assert moved.tolist() == pytest.approx([rate * during_s, 0.0], abs=1e-9)


def test_querying_displacement_keeps_angles_of_the_frame() -> None:
    buffer = JointBuffer(REVOLUTE, max_gap_s=0.1, kept_s=0.1)
    for step in range(60):
        buffer.put(reading(0.01 * step, 0.01 * step, 0.0))
    buffer.moved(0.3, 0.05, 0.0)
    assert buffer.at(0.3, 0.0).tolist() == pytest.approx([0.3, 0.0])
