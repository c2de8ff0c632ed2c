"""Compare sets of causes about several fits: the same set is worth the same about each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from planted_cases import ELBOW, SHOULDER, desk_arm, measured, scattered, surveyed_arm

from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.background import Scales
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.search.scan import Candidate
from bodyschema.diagnosis.search.together import Sets
from bodyschema.effects import Effect, Simulation
from bodyschema.robot.description import RobotDescription

NOISE_M, ROWS = 3e-4, 60


def fit_of(robot: RobotDescription, hidden: Effect, away_m: Sequence[float] = (0.0, 0.0, 0.0)) -> Fit:
    """Return the fit without any cause of an arm with one, seen by an instrument that far from its nominal place."""
    motion = scattered(robot, 1, ROWS)
    x = Simulation(robot, (hidden,)).positions(motion) + np.array(away_m)
    x += NOISE_M * np.random.default_rng(1).normal(size=x.shape)
    recording = measured(robot, motion, x)
    return aligned(Observations.of(recording, Simulation(robot)), Simulation(robot)).tolerating(Scales())


def sets(fit: Fit, cause: Effect) -> Sets:
    return Sets(fit, [Candidate(cause, 0.0, 1)], 0.0)


def test_a_set_is_worth_the_same_about_a_noisy_and_a_quiet_fit_of_a_distant_instrument() -> None:
    robot = desk_arm()
    hidden = Effect.at(robot, "backlash", SHOULDER, values=[0.03])
    without = fit_of(robot, hidden, (3.0, -3.0, 2.0))
    complete = without.with_causes([hidden])
    assert complete.noise.sigma < 0.5 * without.noise.sigma
    worths = [sets(fit, hidden).of(()).worth for fit in (without, complete)]
    assert worths[0] == pytest.approx(worths[1], abs=3.0)


def test_rows_that_are_outliers_without_a_cause_count_against_the_set_without_it() -> None:
    robot = surveyed_arm()
    jump = Effect.at(robot, "encoder_jump", ELBOW, values={"jump_rad": 0.1, "t0": 0.25 * (ROWS - 5.5)})
    without = fit_of(robot, jump)
    assert (without.noise.weights < 0.5).sum() == 6
    assert sets(without.with_causes([jump]), jump).of((0,)).worth > sets(without, jump).of(()).worth + 20.0


def test_a_cause_that_would_be_negative_and_cannot_be_leaves_its_set() -> None:
    robot = surveyed_arm()
    hidden = Effect.at(robot, "backlash", SHOULDER, values=[-0.02])
    assert not hidden.is_possible
    compared = sets(fit_of(robot, hidden), hidden)
    assert [one.chosen for one in compared.climbed([(0,)])] == [()]
