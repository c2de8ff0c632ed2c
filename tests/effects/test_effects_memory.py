"""Effects that depend on the order of the readings: backlash, and the first stage reading by reading."""

from __future__ import annotations

import numpy as np
import pytest
from effect_arms import arm, everywhere, sized, walk
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.effects import EFFECT_TYPES, Effect, LiveEncoders, Motion, Simulation
from bodyschema.effects.catalogue.backlash import follow_backlash
from bodyschema.effects.encoder import EncoderEffect

PATHS = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60).map(np.array)
WIDTHS = st.floats(1e-4, 0.5)
EACH = [name for name, effect in EFFECT_TYPES.items() if isinstance(effect, EncoderEffect)]


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return arm(tmp_path_factory.mktemp("arm"))


@given(PATHS, WIDTHS)
def test_backlash_lag_never_exceeds_half_its_width(q, width) -> None:
    assert np.abs(follow_backlash(q, width)).max() <= 0.5 * width + 1e-12  # of readings around 1


@given(PATHS, WIDTHS)
def test_backlash_output_moves_only_with_its_input(q, width) -> None:
    output = q + follow_backlash(q, width)
    assert (np.diff(output) * np.diff(q) >= -1e-15).all()


@given(st.lists(st.floats(0.01, 0.1), min_size=2, max_size=40), WIDTHS)
def test_one_way_motion_lags_by_half_backlash_width(steps, width) -> None:
    q = np.cumsum(steps)
    np.testing.assert_allclose(follow_backlash(q, width), -0.5 * width, atol=1e-12)


def test_backlash_output_rests_until_width_is_crossed() -> None:
    q = np.array([0.0, 0.1, 0.08, 0.05, 0.0])
    output = q + follow_backlash(q, 0.04)
    np.testing.assert_allclose(output, [-0.02, 0.08, 0.08, 0.07, 0.02], atol=1e-15)


def test_backlash_state_carries_over_between_segments(robot) -> None:
    q = np.zeros((6, len(robot.joints)))
    q[:, 0] = [0.0, 0.1, 0.2, 0.19, 0.195, 0.185]
    play = Simulation(robot, (Effect.at(robot, "backlash", robot.joints[0], values=[0.04]),))
    motion = Motion(q, None, np.array([0, 0, 0, 1, 1, 1]))
    # It was left leading by half its width and has not crossed it since.
    np.testing.assert_allclose(play.unloaded(motion)[3:, 0], 0.18, atol=1e-12)


def reading_by_reading(simulation, motion):
    live, angles = LiveEncoders(simulation), []
    for q, t, move in zip(motion.q, motion.clock, motion.moves, strict=True):
        angles.append(live.true_angles(q, float(t), move))
    return np.array(angles)


@pytest.mark.parametrize("name", EACH)
def test_live_encoders_match_whole_motion_reading_by_reading(robot, name) -> None:
    motion = walk(3)
    # Live rows come at constant intervals.
    times = np.linspace(motion.clock[0], motion.clock[-1], len(motion))
    motion = Motion(motion.q, times, np.zeros(len(motion), dtype=np.int64))
    simulation = Simulation(
        robot, tuple(sized(robot, place, 1.0, 5) for place in everywhere(robot) if place[0] == name)
    )
    # Before its first move, a live backlash has no known side.
    after = slice(1, None)
    expected = simulation.unloaded(motion)
    np.testing.assert_allclose(reading_by_reading(simulation, motion)[after], expected[after], rtol=0, atol=1e-14)


def test_settling_error_decays_with_time_between_rows(robot) -> None:
    q = np.zeros((4, len(robot.joints)))
    q[1:, 0] = 0.1
    settling = Effect.at(robot, "settling", robot.joints[0], values=[0.5, 0.25])
    simulation = Simulation(robot, (settling,))
    motion = Motion(q, np.array([0.0, 1.0, 2.0, 2.5]), np.zeros(4, dtype=np.int64))
    missing = motion.q[:, 0] - simulation.unloaded(motion)[:, 0]
    np.testing.assert_allclose(missing, [0.0, 0.05, 0.05 * 0.25, 0.05 * 0.25 * 0.5], atol=1e-15)
