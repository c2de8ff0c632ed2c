"""Errors outside the effects table are reported as such, and effects that are not there are not found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from planted_cases import ELBOW, SHOULDER, SIGMA_M, desk_arm, measured, motion_of, scattered, seen, surveyed_arm, walk

from bodyschema.diagnosis.diagnosis import Diagnosis, diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.result import DiagnosisFile
from bodyschema.diagnosis.report.text import modelled
from bodyschema.effects import Effect, Motion, Simulation, load_simulation, write_extended
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

PER_RAD = 0.03
ROWS = 200
# Of the effects, those that are most like it: the search among all sets of all effects takes seconds.
NEAREST = ("joint_offset", "joint_scale", "joint_eccentricity", "joint_compliance", "link_geometry")


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return desk_arm()


def squared_positions(robot: RobotDescription, motion: Motion) -> FloatArray:
    """Return positions of an arm whose shoulder errs by `PER_RAD` times the elbow's square."""
    q = motion.q.copy()
    q[:, robot.joints.index(SHOULDER)] += PER_RAD * np.square(motion.q[:, robot.joints.index(ELBOW)])
    return Simulation(robot).positions(motion_of(q))


def squared_recording(robot: RobotDescription) -> Recording:
    motion = walk(robot, 1, ROWS)
    x = squared_positions(robot, motion)
    return measured(robot, motion, x + SIGMA_M * np.random.default_rng([1, 1]).normal(size=x.shape))


def squared(robot: RobotDescription) -> Diagnosis:
    return diagnose(squared_recording(robot), Simulation(robot), only=NEAREST)


@pytest.fixture(scope="module")
def diagnosis(robot) -> Diagnosis:
    return squared(robot)


@pytest.fixture(scope="module")
def file(diagnosis) -> DiagnosisFile:
    return conclusion(diagnosis)


def test_squared_coupling_is_unexplained_with_both_joints(file) -> None:
    assert file.verdict == "unexplained"
    assert set(file.unexplained.depends_on) == {SHOULDER, ELBOW}
    assert file.unexplained.p_value < 1e-6


def test_no_cause_is_named_for_it(file) -> None:
    assert file.causes == ()


def test_unnamed_model_predicts_held_out_rows(file) -> None:
    assert file.rms_mm.extended < 0.2 * file.rms_mm.aligned


def test_unexplained_rms_is_below_the_aligned_error(file) -> None:
    assert 0.5 * file.rms_mm.aligned < file.unexplained.rms_mm < file.rms_mm.aligned


def test_error_without_model_still_includes_tolerances() -> None:
    robot, rng = surveyed_arm(), np.random.default_rng(3)
    joints = [Effect.at(robot, "link_geometry", joint) for joint in robot.joints]
    made = tuple(
        replace(link, values=np.append(1e-3 * rng.normal(size=3), 5e-3 * rng.normal(size=3))) for link in joints
    )
    motion = scattered(robot, 5, 150)
    q = motion.q.copy()
    q[:, robot.joints.index(SHOULDER)] += 0.002 * np.square(q[:, robot.joints.index(ELBOW)])
    x = Simulation(robot, (), None, made).positions(motion_of(q)) + SIGMA_M * rng.normal(size=(150, 3))
    found = diagnose(measured(robot, motion, x), Simulation(robot), only=NEAREST)
    assert found.without_model is not None
    before, without, after = (
        np.sqrt(np.square(d).mean())
        for d in (found.held_out["aligned"], found.without_model, found.held_out["extended"])
    )
    assert after < without < 0.6 * before


def test_the_advice_says_where_to_look(file) -> None:
    (advice,) = file.advice
    assert f"Look at {SHOULDER}, {ELBOW} first." in advice


def stored(diagnosis: Diagnosis, folder: Path) -> Simulation:
    return load_simulation(write_extended(diagnosis.extended.simulation, folder, "x"))


def test_stored_model_corrects_another_path(robot, diagnosis, tmp_path) -> None:
    motion = walk(robot, 2)
    unexplained = stored(diagnosis, tmp_path).positions(motion) - squared_positions(robot, motion)
    learnt = walk(robot, 1, ROWS).q
    inside = np.abs(motion.q - np.median(learnt, axis=0)) < 0.4 * np.ptp(learnt, axis=0)
    assert np.sqrt(np.square(unexplained[inside.all(axis=1)]).sum(axis=1).mean()) < 0.5 * SIGMA_M * np.sqrt(3.0)


def test_rediagnosis_with_stored_model_finds_nothing(robot, diagnosis, tmp_path) -> None:
    simulation = stored(diagnosis, tmp_path)
    again = conclusion(diagnose(squared_recording(robot), simulation, only=NEAREST))
    assert (again.verdict, again.causes, again.unexplained.depends_on) == ("nothing_found", (), ())


def test_held_out_error_matches_the_stored_model_s_error(robot, diagnosis, file, tmp_path) -> None:
    motion = walk(robot, 1, ROWS)
    off = stored(diagnosis, tmp_path).positions(motion) - squared_positions(robot, motion)
    truth_mm = 1e3 * np.sqrt(np.square(off).sum(axis=1).mean() + 3.0 * SIGMA_M**2)
    assert abs(file.rms_mm.extended / truth_mm - 1.0) < 0.05


@pytest.mark.soak
def test_time_drift_is_reported_as_outside_the_model(robot) -> None:
    motion = walk(robot, 1, rows=60)
    q = motion.q.copy()
    q[:, robot.joints.index(SHOULDER)] += 0.02 * np.sin(np.linspace(0.0, 9.0, len(q)))
    x = Simulation(robot).positions(motion_of(q))
    noise = SIGMA_M * np.random.default_rng([1, 1]).normal(size=x.shape)
    nearest = ("joint_offset", "joint_scale", "encoder_jump", "thermal_drift", "tool_slip", "camera_moved")
    diagnosis = diagnose(measured(robot, motion, x + noise), Simulation(robot), only=nearest)
    unexplained = conclusion(diagnosis).unexplained
    assert diagnosis.extended.simulation.residual is None
    assert diagnosis.causes == ()
    assert (unexplained.model_joints, unexplained.not_in_model) == ((), unexplained.what)
    assert "What changes with time is in no such model" in modelled(unexplained)


@pytest.mark.soak
def test_warming_link_is_unexplained_without_named_cause(robot) -> None:
    motion = walk(robot, 1)
    columns = Simulation(robot).run(motion).columns(Effect.at(robot, "link_geometry", ELBOW))
    grown = 1.0 - np.exp(-motion.clock / (0.15 * motion.clock[-1]))
    x = Simulation(robot).positions(motion) + grown[:, None] * (columns @ np.array([1e-3, 2e-3, -1e-3, 0.0, 0.0, 0.0]))
    noise = SIGMA_M * np.random.default_rng([1, 1]).normal(size=x.shape)
    found = conclusion(diagnose(measured(robot, motion, x + noise), Simulation(robot)))
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert {ELBOW, "time"} <= set(found.unexplained.depends_on)


@pytest.mark.soak
def test_image_dependent_depth_error_is_unexplained_but_learnt() -> None:
    robot, motion = surveyed_arm(), walk(surveyed_arm(), 1)
    right = Simulation(robot).positions(motion)
    x = right * (1.0 + 0.04 * np.square(right[:, :1] / right[:, 2:]))
    noise = SIGMA_M * np.random.default_rng([1, 1]).normal(size=x.shape)
    diagnosis = diagnose(measured(robot, motion, x + noise), Simulation(robot))
    found = conclusion(diagnosis)
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert found.rms_mm.extended < 1.3 * (found.rms_mm.noise_floor or 0.0)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in (1, 2))])
def test_where_nothing_is_hidden_nothing_is_found(robot, seed) -> None:
    found = conclusion(diagnose(seen(robot, walk(robot, seed), (), seed), Simulation(robot)))
    assert (found.verdict, found.causes, found.unexplained.depends_on) == ("nothing_found", (), ())


def test_a_named_cause_alone_leaves_nothing_unexplained(robot) -> None:
    truth = Effect.at(robot, "joint_eccentricity", SHOULDER, values=[0.02, 0.01])
    found = conclusion(diagnose(seen(robot, walk(robot, 1, ROWS), (truth,), 1), Simulation(robot)))
    assert [(cause.effect, cause.where) for cause in found.causes] == [("joint_eccentricity", SHOULDER)]
    assert found.unexplained.depends_on == ()


def smooth_walk(robot: RobotDescription, seed: int, rows: int) -> Motion:
    """Return a walk whose path between two readings is known."""
    q = walk(robot, seed, rows + 40).q
    return motion_of(np.stack([np.convolve(angles, np.full(41, 1 / 41), "valid") for angles in q.T], axis=1)[:rows])


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("robot", [desk_arm(), surveyed_arm()], ids=["placed", "surveyed"])
def test_clock_drift_is_reported_beside_mean_latency(robot, seed) -> None:
    motion, simulation = smooth_walk(robot, seed, 300), Simulation(robot)
    late = np.linspace(0.02, 0.5, len(motion))
    x = simulation.positions(motion.earlier(late))
    x += SIGMA_M * np.random.default_rng([seed, 1]).normal(size=x.shape)
    diagnosis = diagnose(measured(robot, motion, x), simulation, only=("camera_latency", "camera_moved", "tool_slip"))
    file = conclusion(diagnosis)
    assert file.verdict == "unexplained"
    assert [cause.effect for cause in file.causes] == ["camera_latency"]
    assert diagnosis.unexplained.what == ("the clocks of images and joints run apart",)
    assert file.rms_mm.noise_floor is not None
    assert file.rms_mm.noise_floor < 1.5e3 * SIGMA_M * np.sqrt(3.0)


def wandering(rows: int, seed: int) -> FloatArray:
    """Return errors (n, 3) that neighbouring rows share, and that no joint, place or slow function of time predicts."""
    steps = np.random.default_rng([seed, 3]).normal(size=(rows + 24, 3))
    return np.stack([np.convolve(axis, np.full(25, 25**-0.5), "valid") for axis in steps.T], axis=1)


@pytest.mark.parametrize("seed", [1, 2])
def test_unpredictable_wandering_is_unexplained_rather_than_noise(robot, seed) -> None:
    motion, simulation = walk(robot, seed, ROWS), Simulation(robot)
    noise = SIGMA_M * np.random.default_rng([seed, 1]).normal(size=(ROWS, 3))
    x = simulation.positions(motion) + noise + 20.0 * SIGMA_M * wandering(ROWS, seed)
    file = conclusion(diagnose(measured(robot, motion, x), simulation, only=NEAREST))
    assert file.verdict == "unexplained"
    assert file.rms_mm.noise_floor is not None
    assert file.rms_mm.noise_floor < 8.0e3 * SIGMA_M * np.sqrt(3.0)
