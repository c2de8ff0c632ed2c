from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.daemon.config import DaemonConfig
from bodyschema.daemon.sampler.gate import PairGate
from bodyschema.interfaces.records import Pair, Reason, frozen_array

FRAME_S = 1 / 30
TWO_REVOLUTE = np.array([False, False])
HERE = np.array([0.3, 0.1, 1.0])


def moved(*by: float) -> np.ndarray:
    return HERE + np.array(by)


def at_deg(*degrees: float) -> np.ndarray:
    return np.radians(degrees)


class Walk:
    """Offers one measurement a frame to a gate and keeps the verdicts."""

    def __init__(self, gate: PairGate, t: float = 100.0) -> None:
        self.gate, self.t = gate, t

    def offer(self, *degrees: float, x: np.ndarray = HERE, after_s: float = FRAME_S) -> int | Reason:
        self.t += after_s
        return self.gate.offer(self.t, at_deg(*degrees), x)


@pytest.fixture
def walk() -> Walk:
    return Walk(PairGate(DaemonConfig(), TWO_REVOLUTE))


def test_first_measurement_starts_segment_one(walk) -> None:
    assert walk.offer(10, 20) == 1


@given(step=st.floats(1.001, 2.999), direction=st.floats(0, 2 * np.pi))
def test_step_of_one_to_three_degrees_continues_segment(step, direction) -> None:
    walk = Walk(PairGate(DaemonConfig(), TWO_REVOLUTE))
    walk.offer(10, 20)
    assert walk.offer(10 + step * np.cos(direction), 20 + step * np.sin(direction)) == 1


@given(step=st.floats(0.0, 0.999), direction=st.floats(0, 2 * np.pi))
def test_a_smaller_step_has_to_wait(step, direction) -> None:
    walk = Walk(PairGate(DaemonConfig(), TWO_REVOLUTE))
    walk.offer(10, 20)
    assert walk.offer(10 + step * np.cos(direction), 20 + step * np.sin(direction)) is Reason.TOO_NEAR


def test_small_steps_add_up_to_a_pair(walk) -> None:
    walk.offer(0, 0)
    verdicts = [walk.offer(0.4 * i, 0) for i in range(1, 7)]
    assert verdicts == [Reason.TOO_NEAR, Reason.TOO_NEAR, 1] * 2


def test_larger_step_starts_new_segment(walk) -> None:
    walk.offer(0, 0)
    assert [walk.offer(3.1, 0), walk.offer(5.1, 0)] == [2, 2]


def test_a_pause_starts_a_new_segment(walk) -> None:
    walk.offer(0, 0)
    assert walk.offer(2, 0, after_s=1.1) == 2


def test_short_marker_loss_keeps_segment(walk) -> None:
    walk.offer(0, 0)
    assert walk.offer(2, 0, after_s=0.9) == 1


def test_a_broken_segment_ends_even_without_a_pause(walk) -> None:
    walk.offer(0, 0)
    walk.gate.break_segment()
    assert walk.offer(2, 0) == 2


def test_resting_arm_gives_no_further_pair(walk) -> None:
    walk.offer(0, 0)
    assert {walk.offer(0.1, 0, after_s=10.0) for _ in range(5)} == {Reason.TOO_NEAR}


def test_restart_continues_from_last_pair_in_new_segment() -> None:
    last = Pair("store", 7, 4, 1e9, "", frozen_array(at_deg(10, 20)), frozen_array(HERE), frozen_array(np.eye(3)))
    walk = Walk(PairGate(DaemonConfig(), TWO_REVOLUTE, last))
    assert [walk.offer(10.5, 20), walk.offer(12, 20), walk.offer(14, 20)] == [Reason.TOO_NEAR, 5, 5]


def test_prismatic_step_is_scaled_by_metres_per_degree() -> None:
    walk = Walk(PairGate(DaemonConfig(metres_per_degree=0.01), np.array([True])))
    walk.t += FRAME_S
    walk.gate.offer(walk.t, np.array([0.5]), HERE)
    verdicts = [walk.gate.offer(walk.t + FRAME_S * i, np.array([0.5 + 0.009 * i]), HERE) for i in (1, 2)]
    assert verdicts == [Reason.TOO_NEAR, 1]


def test_an_angle_that_wraps_is_no_jump(walk) -> None:
    walk.offer(179, 0)
    assert walk.offer(-179, 0) == 1


def test_single_frame_marker_jump_is_rejected(walk) -> None:
    walk.offer(0, 0)
    assert walk.offer(2, 0, x=moved(0, 1.0, 0)) is Reason.IMPLAUSIBLE_SPEED
    assert walk.offer(2, 0) == 1


def test_persistent_marker_jump_starts_new_segment(walk) -> None:
    walk.offer(0, 0)
    there = moved(0, 0.25, 0)  # a longer tool
    verdicts = [walk.offer(2.0 * i, 0, x=there) for i in range(1, 5)]
    doubts = verdicts.count(Reason.IMPLAUSIBLE_SPEED)
    assert 1 <= doubts <= 2
    assert verdicts[doubts:] == [2] * (4 - doubts)


def test_marks_that_flicker_between_places_are_not_confirmed(walk) -> None:
    walk.offer(0, 0)
    places = [moved(0, 1.0, 0), moved(0, -1.0, 0), moved(1.0, 0, 0), moved(-1.0, 0, 0)]
    verdicts = {walk.offer(2, 0, x=place) for place in places}
    assert verdicts == {Reason.IMPLAUSIBLE_SPEED}


def test_marker_may_be_anywhere_after_long_loss(walk) -> None:
    walk.offer(0, 0)
    assert walk.offer(2, 0, x=moved(0, 5.0, 0), after_s=1.5) == 2


def test_speed_check_uses_last_fix_not_last_pair(walk) -> None:
    walk.offer(0, 0)
    for i in range(1, 60):
        walk.offer(0.01, 0, x=moved(0, 0.02 * i, 0))
    assert walk.offer(2, 0, x=moved(0, 1.2, 0)) == 2  # two seconds after the last pair


def test_any_step_takes_poses_however_near_or_far() -> None:
    walk = Walk(PairGate(DaemonConfig(any_step=True), TWO_REVOLUTE))
    verdicts = [walk.offer(0, 0), walk.offer(0, 0), walk.offer(80, -60, x=moved(0, 2.0, 0)), walk.offer(82, -60)]
    assert verdicts == [1, 1, 2, 2]
