"""Causes of a long recording are sought in a part of it, and fitted to all of it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from planted_cases import ELBOW, SHOULDER, SIGMA_M, WRIST, desk_arm, measured, motion_of, seen, surveyed_arm, walk

from bodyschema.diagnosis import diagnosis
from bodyschema.diagnosis.diagnosis import Diagnosis, diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.effects import Effect, Motion, Simulation

ROWS, PART = 360, 120
OFFSET_RAD, JUMP_RAD, JUMPED_AT = 0.02, 0.03, 163.5


@pytest.fixture(scope="module", autouse=True)
def in_a_part() -> Iterator[None]:
    """Call a recording of more than 240 rows long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnosis.DiagnosisSettings, "max_rows", PART)
        patch.setattr(diagnosis.DiagnosisSettings, "run", 20)
        yield


@pytest.fixture(scope="module")
def long() -> Diagnosis:
    """Return the diagnosis of an arm with an offset, whose elbow jumps between two of the runs looked at."""
    robot = surveyed_arm()
    motion = walk(robot, 1, rows=ROWS)
    truth = (
        Effect.at(robot, "joint_offset", SHOULDER, values=[OFFSET_RAD]),
        Effect.at(robot, "encoder_jump", ELBOW, values=[JUMP_RAD, JUMPED_AT / 4.0]),
    )
    return diagnose(seen(robot, motion, truth, 1), Simulation(robot), only=("joint_offset", "encoder_jump"))


def test_partial_motion_keeps_clock_and_splits_at_gaps() -> None:
    motion = Motion(np.arange(12.0)[:, None], None, np.repeat([0, 1], 6))
    part = motion.some(np.array([0, 1, 2, 5, 6, 7, 10]))
    np.testing.assert_array_equal(part.clock, [0, 1, 2, 5, 6, 7, 10])
    np.testing.assert_array_equal(part.begins, [True, False, False, True, True, False, True])
    assert part.moves[2, 0] == 1.0
    assert part.moves[3, 0] == 0.0


def test_long_recording_is_sampled_from_end_to_end() -> None:
    rows = diagnosis._searched_rows(np.zeros(ROWS, dtype=np.bool_))
    assert (rows[0], rows[-1], len(rows)) == (0, ROWS - 1, PART)
    assert len(diagnosis._searched_rows(np.zeros(2 * PART, dtype=np.bool_))) == 2 * PART


def test_sampled_runs_avoid_breaks_in_the_recording() -> None:
    begins = np.zeros(ROWS, dtype=np.bool_)
    begins[::ROWS] = True
    begins[[70, 75, 80, 85]] = True  # from 68 to 87 would be the second run
    rows = diagnosis._searched_rows(begins).reshape(-1, 20)
    assert rows[1, 0] == 85
    np.testing.assert_array_equal(rows[2], np.arange(136, 156))


def test_causes_from_part_are_fitted_to_all_rows(long: Diagnosis) -> None:
    assert long.part is not None
    assert len(long.part) == PART
    assert {cause.key[:2] for cause in long.causes} == {("joint_offset", SHOULDER), ("encoder_jump", ELBOW)}
    offset, jump = sorted(long.causes, key=lambda cause: cause.kind.begins)
    assert offset.values[0] == pytest.approx(OFFSET_RAD, abs=3e-4)
    assert jump.values[0] == pytest.approx(JUMP_RAD, abs=3e-4)
    assert len(long.markers) == ROWS


def test_jump_time_between_sampled_runs_is_found(long: Diagnosis) -> None:
    found = next(cause for cause in conclusion(long).causes if cause.effect == "encoder_jump").parameters["t0"]
    assert found.value == pytest.approx(JUMPED_AT / 4.0, abs=0.3)
    assert found.ci95[1] - found.ci95[0] < 2.0


@pytest.mark.soak
def test_unnamed_error_is_learnt_from_all_rows() -> None:
    robot = desk_arm()
    motion = walk(robot, 1, rows=ROWS)
    q = motion.q.copy()
    q[:, robot.joints.index(SHOULDER)] += 0.03 * np.square(motion.q[:, robot.joints.index(ELBOW)])
    x = Simulation(robot).positions(motion_of(q))
    x += SIGMA_M * np.random.default_rng([1, 1]).normal(size=x.shape)
    found = diagnose(measured(robot, motion, x), Simulation(robot), only=("joint_scale", "joint_offset"))
    file = conclusion(found)
    assert file.verdict == "unexplained"
    assert WRIST not in file.unexplained.depends_on
    assert found.unexplained.model is not None
    assert len(found.unexplained.model.explained) == ROWS
    assert file.rms_mm.extended < 1.3e3 * np.sqrt(3.0) * SIGMA_M
