"""The unknown state at the start of a run is not assumed for the rows that depend on it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from planted_cases import INTERVAL_S, SHOULDER, desk_arm, measured, motion_of, seen, walk

from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

RUN, UNSEEN = 20, 4


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return desk_arm()


def recorded(robot: RobotDescription, *effects: Effect, seed: int = 3) -> Recording:
    """Return the recording of a walk on which the marker is lost every few rows."""
    way = walk(robot, seed, 600)
    x = seen(robot, way, effects, seed).x
    kept = np.arange(len(way)) % (RUN + UNSEEN) < RUN
    assert way.t is not None
    t = way.t[kept]
    segment = np.cumsum(np.diff(t, prepend=0.0) > 1.5 * INTERVAL_S, dtype=np.int64)
    return measured(robot, Motion(way.q[kept], t, segment), x[kept])


def in_runs(robot: RobotDescription, *effects: Effect) -> Fit:
    """Return the effects fitted to such a recording."""
    observations = Observations.of(recorded(robot, *effects), Simulation(robot))
    return aligned(observations, Simulation(robot)).with_causes(effects)


def test_settling_joint_is_trusted_after_its_memory_decays(robot) -> None:
    lacking = in_runs(robot, Effect.at(robot, "settling", SHOULDER, values=[0.3, 0.3])).unknown_history()
    rows = np.flatnonzero(lacking[:RUN])
    # 0.3 and 0.09 of it are more than a twentieth, 0.027 is not; the first row is never trusted in a walk.
    np.testing.assert_array_equal(rows, [1, 2])


def test_joint_without_memory_is_trusted_at_once(robot) -> None:
    assert not in_runs(robot, Effect.at(robot, "settling", SHOULDER, values=[0.3, 0.0])).unknown_history().any()


def test_excluding_unsettled_rows_leaves_no_outliers(robot) -> None:
    fit = in_runs(robot, Effect.at(robot, "settling", SHOULDER, values=[0.5, 0.3]))
    again = aligned(fit.observations.ignoring(fit.unknown_history()), Simulation(robot)).with_causes(fit.causes)
    assert fit.noise.share > 0.02
    assert again.noise.share < 0.005


def test_backlash_side_is_known_after_crossing(robot) -> None:
    q = np.tile(np.median(walk(robot, 3).q, axis=0), (6, 1))
    q[:, robot.joints.index(SHOULDER)] += [0.0, 0.01, 0.02, 0.03, 0.02, 0.01]
    play = Effect.at(robot, "backlash", SHOULDER, values=[0.025])
    run = Simulation(robot, (play,)).run(motion_of(q))
    np.testing.assert_array_equal(play.kind.unknown_state(run, play), [True, True, True, False, False, False])


def test_backlash_side_is_trusted_after_first_crossing(robot) -> None:
    fit = in_runs(robot, Effect.at(robot, "backlash", SHOULDER, values=[0.2]))
    reached = fit.observations.motion.q[:, robot.joints.index(SHOULDER)]
    crossed = np.maximum.accumulate(reached) - np.minimum.accumulate(reached) >= fit.causes[0].values[0]
    assert fit.unknown_history()[crossed].any()
    np.testing.assert_array_equal(fit.unknown_history_at_first[1:], ~crossed[1:])


@pytest.mark.parametrize("seed", [3, 4])
def test_rarely_crossed_backlash_is_the_only_cause_found(robot, seed) -> None:
    play = Effect.at(robot, "backlash", SHOULDER, values=[0.2])
    found = diagnose(recorded(robot, play, seed=seed), Simulation(robot))
    assert [cause.key for cause in found.causes] == [play.key]
    assert not found.unexplained.is_present


def test_backlash_side_is_unknown_only_within_friction_band(robot) -> None:
    torque = np.array([10.0, 3.0, -0.4, -0.8, -3.0, -10.0])  # friction of 1 N m lets go at -1
    play = Effect.at(robot, "gravity_backlash", SHOULDER, values=[0.01, 1.0])
    k = robot.joints.index(SHOULDER)
    torques = np.outer(torque, np.arange(len(robot.joints)) == k)
    run = SimpleNamespace(simulation=Simulation(robot, (play,)), torques=torques)
    np.testing.assert_array_equal(play.kind.unknown_state(run, play), [False, False, False, True, False, False])
