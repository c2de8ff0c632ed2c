"""What none of the effects can do is told as such, and what is not there is not found."""

from __future__ import annotations

import numpy as np
import pytest
from planted_cases import ELBOW, SHOULDER, SIGMA_M, desk_arm, measured, motion_of, seen, walk

from diagnosis.conclusion import conclusion
from diagnosis.diagnosis import Diagnosis, diagnose
from diagnosis.result import DiagnosisFile
from effects import Effect, Simulation
from interfaces.robot import RobotDescription

PER_RAD = 0.03


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return desk_arm()


def squared(robot: RobotDescription) -> Diagnosis:
    """Of an arm whose shoulder errs by `PER_RAD` times the elbow's square."""
    motion = walk(robot, 1)
    q = motion.q.copy()
    q[:, robot.joints.index(SHOULDER)] += PER_RAD * np.square(motion.q[:, robot.joints.index(ELBOW)])
    x = Simulation(robot).positions(motion_of(q))
    noise = SIGMA_M * np.random.default_rng([1, 1]).normal(size=x.shape)
    return diagnose(measured(robot, motion, x + noise), Simulation(robot))


@pytest.fixture(scope="module")
def diagnosis(robot) -> Diagnosis:
    return squared(robot)


@pytest.fixture(scope="module")
def file(diagnosis) -> DiagnosisFile:
    return conclusion(diagnosis)


def test_an_error_that_depends_on_another_joints_square_is_unexplained_with_both_joints(file) -> None:
    assert file.verdict == "unexplained"
    assert set(file.unexplained.depends_on) == {SHOULDER, ELBOW}
    assert file.unexplained.p_value < 1e-6


def test_no_cause_is_named_for_it(file) -> None:
    assert file.causes == ()


def test_the_model_of_what_has_no_name_predicts_rows_that_it_was_not_fitted_to(file) -> None:
    assert file.rms_mm.extended < 0.2 * file.rms_mm.aligned


def test_the_advice_says_where_to_look(file) -> None:
    (advice,) = file.advice
    assert f"Look at {SHOULDER}, {ELBOW} first." in advice


def test_where_nothing_is_hidden_nothing_is_found(robot) -> None:
    for seed in range(3):
        found = conclusion(diagnose(seen(robot, walk(robot, seed), (), seed), Simulation(robot)))
        assert (found.verdict, found.causes, found.unexplained.depends_on) == ("nothing_found", (), ())


def test_a_named_cause_alone_leaves_nothing_unexplained(robot) -> None:
    truth = Effect.at(robot, "joint_eccentricity", SHOULDER, values=[0.02, 0.01])
    found = conclusion(diagnose(seen(robot, walk(robot, 1), (truth,), 1), Simulation(robot)))
    assert [(cause.effect, cause.where) for cause in found.causes] == [("joint_eccentricity", SHOULDER)]
    assert found.unexplained.depends_on == ()
