"""An arm with tolerances everywhere: only errors larger than its tolerances are named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from planted_cases import ELBOW, SHOULDER, desk_arm, measured, motion_of, scattered, start_of, surveyed_arm, walk

from bodyschema.diagnosis.assess.explanation import _is_worth_reporting
from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.background import Scales
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.result import DiagnosisFile
from bodyschema.diagnosis.search.joint_selection import estimated_tolerances, exceeds_tolerances
from bodyschema.diagnosis.search.scan import Candidate
from bodyschema.diagnosis.search.sets import CauseSets
from bodyschema.effects import Effect, Simulation, load_simulation, write_extended
from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.description import RobotDescription

NOISE_M, ROWS = 1e-4, 150
LENGTH_M, ANGLE_RAD, DRIVE_RAD = 4e-4, 1.2e-3, 2e-4


def made(robot: RobotDescription, rng: np.random.Generator) -> tuple[Effect, ...]:
    """Return a robot with realistic tolerances of every link and drive."""
    found = []
    for joint in robot.joints:
        link = np.concatenate([LENGTH_M * rng.normal(size=3), ANGLE_RAD * rng.normal(size=3)])
        found.append(Effect.at(robot, "link_geometry", joint, values=link))
        found.append(Effect.at(robot, "joint_eccentricity", joint, values=DRIVE_RAD * rng.normal(size=2)))
    return tuple(found)


def found_in(robot: RobotDescription, seed: int, *causes: Effect) -> DiagnosisFile:
    rng = np.random.default_rng([7, seed])
    q = rng.uniform(0.7 * robot.lower, 0.7 * robot.upper, (ROWS, len(robot.joints)))
    truth = Simulation(robot, causes, None, made(robot, rng))
    x = truth.positions(motion_of(q)) + NOISE_M * rng.normal(size=(ROWS, 3))
    return conclusion(diagnose(measured(robot, motion_of(q), x), Simulation(robot)))


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return surveyed_arm()


@pytest.fixture(scope="module")
def plain(robot: RobotDescription) -> DiagnosisFile:
    return found_in(robot, 1)


def test_nothing_is_named_where_all_is_within_tolerance(plain: DiagnosisFile) -> None:
    assert (plain.verdict, plain.causes) == ("nothing_found", ())
    assert "small errors everywhere" in plain.sentence


def test_link_length_tolerance_is_estimated_with_interval(plain: DiagnosisFile) -> None:
    assert plain.tolerances is not None
    assert 0.5e3 * LENGTH_M < plain.tolerances.length_mm.value < 2e3 * LENGTH_M
    low, high = plain.tolerances.length_mm.ci95
    assert low < plain.tolerances.length_mm.value < high


def test_drive_error_interval_contains_the_truth(plain: DiagnosisFile) -> None:
    assert plain.tolerances is not None
    low, high = plain.tolerances.drive_deg.ci95
    assert low < np.degrees(DRIVE_RAD) < high


def test_tolerances_reduce_error_nearly_to_the_noise(plain: DiagnosisFile) -> None:
    assert plain.rms_mm.noise_floor is not None
    assert plain.rms_mm.extended < 1.5e3 * NOISE_M * np.sqrt(3.0) < 0.5 * plain.rms_mm.aligned
    assert plain.rms_mm.noise_floor < plain.rms_mm.extended


HIDDEN = {SHOULDER: 0.035, ELBOW: -0.04}


@pytest.fixture(scope="module")
def with_zeros(robot: RobotDescription) -> DiagnosisFile:
    return found_in(robot, 2, *(Effect.at(robot, "joint_offset", at, values=[size]) for at, size in HIDDEN.items()))


def test_joint_offsets_are_named_without_substitute_links(with_zeros: DiagnosisFile) -> None:
    file = with_zeros
    assert {(cause.effect, cause.where) for cause in file.causes} == {("joint_offset", joint) for joint in HIDDEN}
    by_joint = {cause.where: cause.parameters["offset_rad"].value for cause in file.causes}
    assert by_joint[SHOULDER] == pytest.approx(0.035, abs=5.0 * ANGLE_RAD)
    assert by_joint[ELBOW] == pytest.approx(-0.04, abs=5.0 * ANGLE_RAD)


def test_link_bent_beyond_tolerance_is_named(robot: RobotDescription) -> None:
    bent = Effect.at(robot, "link_geometry", ELBOW, values=[4e-3, 0.0, 5e-3, 0.0, 0.02, 0.01])
    file = found_in(robot, 3, bent)
    assert [(cause.effect, cause.where) for cause in file.causes] == [("link_geometry", ELBOW)]


@pytest.mark.parametrize("seed", [5, 8])
def test_camera_pose_is_named_despite_absorbing_tolerances(robot: RobotDescription, seed: int) -> None:
    file = found_in(robot, seed, Effect.at(robot, "camera_pose", values=[3e-3, 1e-3, -2e-3, 6e-3, -3e-3, 5e-3]))
    assert [(cause.effect, cause.where) for cause in file.causes] == [("camera_pose", None)]


def test_link_hidden_by_tolerances_leaves_verdict_undecided(robot: RobotDescription) -> None:
    file = found_in(robot, 5, Effect.at(robot, "link_geometry", ELBOW, values=[2e-3, 0.0, 2.5e-3, 0.0, 0.01, 0.005]))
    assert file.tolerances is not None
    assert (file.verdict, file.causes) == ("undecided", ())
    assert [(rival.effect, rival.where) for rival in file.tolerances.rivals] == [("link_geometry", ELBOW)]
    assert "small errors everywhere (or a wrong link before joint" in file.sentence


def _with_small_tolerances(robot: RobotDescription) -> Fit:
    """Return a fit of a joint offset with tolerances that are smaller than the arm's."""
    rng = np.random.default_rng([7, 4])
    q = rng.uniform(0.7 * robot.lower, 0.7 * robot.upper, (ROWS, len(robot.joints)))
    offset = Effect.at(robot, "joint_offset", ELBOW, values=[0.04])
    x = Simulation(robot, (offset,), None, made(robot, rng)).positions(motion_of(q))
    recording = measured(robot, motion_of(q), x + NOISE_M * rng.normal(size=x.shape))
    start = aligned(Observations.of(recording, Simulation(robot)), Simulation(robot))
    return start.with_causes([offset]).with_tolerances(Scales(0.5, 0.5, 0.5))


def test_interval_includes_uncertainty_of_the_tolerances(robot: RobotDescription, monkeypatch) -> None:
    fit = _with_small_tolerances(robot)
    (place,) = fit.places(fit.causes[0])
    integrated = fit.covariance[place, place]
    monkeypatch.setattr("bodyschema.diagnosis.fit.fit.FitSettings.nodes", np.zeros(1))
    assert integrated > 1.2 * replace(fit).covariance[place, place]


@pytest.mark.parametrize("count", [5, 39])
def test_interval_hardly_depends_on_quadrature_node_count(robot: RobotDescription, monkeypatch, count) -> None:
    fit = _with_small_tolerances(robot)
    (place,) = fit.places(fit.causes[0])
    before = fit.covariance[place, place]
    monkeypatch.setattr("bodyschema.diagnosis.fit.fit.FitSettings.nodes", np.linspace(-3.0, 3.0, count))
    assert np.sqrt(replace(fit).covariance[place, place] / before) == pytest.approx(1.0, abs=0.05)


def test_prismatic_ripple_is_tolerated_despite_exact_links(robot: RobotDescription) -> None:
    rng = np.random.default_rng(5)
    q = rng.uniform(robot.lower, robot.upper, (ROWS, len(robot.joints)))
    recording = measured(robot, motion_of(q), Simulation(robot).positions(motion_of(q)))
    fit = aligned(Observations.of(recording, Simulation(robot)), Simulation(robot)).with_tolerances(Scales(lengths=0.1))
    ripple = Effect.at(robot, "joint_ripple", ELBOW, values=[5e-5, 0.0, 16.0])
    assert fit.background.is_within_tolerance(replace(ripple, prismatic=True))
    exact = fit.with_tolerances(Scales(slides=0.1))
    assert not exact.background.is_within_tolerance(replace(ripple, prismatic=True))


def test_background_survives_extended_toml_round_trip(robot: RobotDescription, tmp_path: Path) -> None:
    simulation = Simulation(robot, (), None, made(robot, np.random.default_rng(3)))
    again = load_simulation(write_extended(simulation, tmp_path, "x"))
    q = np.random.default_rng(4).uniform(robot.lower, robot.upper, (20, len(robot.joints)))
    np.testing.assert_allclose(again.positions(motion_of(q)), simulation.positions(motion_of(q)), atol=1e-12)
    assert again.effects == ()


def test_background_with_unknown_joint_is_rejected_with_line(robot: RobotDescription, tmp_path: Path) -> None:
    file = write_extended(Simulation(robot, (), None, made(robot, np.random.default_rng(3))), tmp_path, "x")
    file.write_text(file.read_text().replace(f'where = "{ELBOW}"', 'where = "knee"', 1))
    with pytest.raises(ConfigError, match="background 5") as refused:
        load_simulation(file)
    assert refused.value.line is not None


def test_a_written_simulation_is_refitted_to_second_order() -> None:
    robot, left, first_order = desk_arm(), 0.0, 0.0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        values = np.concatenate([1e-3 * rng.normal(size=(4, 3)), 0.06 * rng.normal(size=(4, 3))], axis=1)
        links = (
            Effect.at(robot, "link_geometry", *link) for link in zip(robot.joints, [None] * 4, values, strict=True)
        )
        truth, motion = Simulation(robot, tuple(links)), scattered(robot, seed, ROWS)
        recording = measured(robot, motion, truth.positions(motion) + NOISE_M * rng.normal(size=(ROWS, 3)))
        start = aligned(Observations.of(recording, Simulation(robot)), Simulation(robot))
        fit = start.with_tolerances(Scales(10.0, 10.0, 1.0))
        left += float(np.square(fit.written.positions(motion) - recording.x).sum())
        first_order += float(np.square(fit.with_tolerances_applied().predicted - recording.x).sum())
    assert left < 0.7 * first_order


def test_joint_scale_is_named_despite_absorbing_drive_errors(robot: RobotDescription) -> None:
    rng = np.random.default_rng([7, 6])
    # The elbow moves little, so that its eccentricity can do what its ratio does.
    reach = np.where(np.array(robot.joints) == ELBOW, 0.15, 0.7)
    q = rng.uniform(reach * robot.lower, reach * robot.upper, (ROWS, len(robot.joints)))
    ratio = Effect.at(robot, "joint_scale", ELBOW, values=[0.02])
    x = Simulation(robot, (ratio,), None, made(robot, rng)).positions(motion_of(q))
    recording = measured(robot, motion_of(q), x + NOISE_M * rng.normal(size=x.shape))
    start = aligned(Observations.of(recording, Simulation(robot)), Simulation(robot))
    fit = start.with_causes([ratio]).with_tolerances(Scales())
    assert exceeds_tolerances(fit, fit.causes[0], naming_cost=4.0)


@pytest.mark.parametrize(("size", "beyond"), [(7.0, False), (30.0, True)])
def test_two_offsets_that_need_each_other_are_tolerances(robot: RobotDescription, size: float, beyond: bool) -> None:
    # Without either one, tolerances have to be as large as without both, and one name alone gains nothing.
    rng, angle = np.random.default_rng([7, 3]), 3e-3
    q = rng.uniform(0.7 * robot.lower, 0.7 * robot.upper, (ROWS, len(robot.joints)))
    links = [np.concatenate([2e-3 * rng.normal(size=3), angle * rng.normal(size=3)]) for _ in robot.joints]
    parts = zip(robot.joints, links, strict=True)
    tolerances = tuple(Effect.at(robot, "link_geometry", joint, values=values) for joint, values in parts)
    offsets = [Effect.at(robot, "joint_offset", j, values=[s * size * angle]) for j, s in ((SHOULDER, 1), (ELBOW, -1))]
    x = Simulation(robot, tuple(offsets), None, tolerances).positions(motion_of(q))
    recording = measured(robot, motion_of(q), x + NOISE_M * rng.normal(size=x.shape))
    fit = aligned(Observations.of(recording, Simulation(robot)), Simulation(robot)).with_causes(offsets)
    fit = fit.with_tolerances(Scales())
    fit = fit.with_tolerances(estimated_tolerances(fit).scales)
    assert [exceeds_tolerances(fit, cause, naming_cost=4.0) for cause in fit.causes] == [beyond, beyond]


def test_bounds_of_undetected_tolerances_scale_with_the_noise(robot: RobotDescription) -> None:
    rng, found = np.random.default_rng([7, 9]), []
    q = rng.uniform(0.7 * robot.lower, 0.7 * robot.upper, (ROWS, len(robot.joints)))
    noise = rng.normal(size=(ROWS, 3))
    for noise_m in (NOISE_M, 20.0 * NOISE_M):
        recording = measured(robot, motion_of(q), Simulation(robot).positions(motion_of(q)) + noise_m * noise)
        start = aligned(Observations.of(recording, Simulation(robot)), Simulation(robot))
        found.append(estimated_tolerances(start.with_tolerances(Scales())))
    assert not any(one.is_detected.any() for one in found)
    # No joint slides.
    quiet, noisy = (one.upper_limit[:3] for one in found)
    assert (noisy > 4.0 * quiet).all()


def test_tolerances_cannot_stand_for_a_moment(robot: RobotDescription) -> None:
    jump = Effect.at(robot, "encoder_jump", ELBOW, values={"jump_rad": 0.02, "t0": 12.0})
    start = start_of(robot, scattered(robot, 3, ROWS), (jump,), 3)
    fit = start.with_causes([jump]).with_tolerances(Scales())
    assert exceeds_tolerances(fit, fit.causes[0], naming_cost=4.0) is None


@pytest.mark.parametrize(
    ("name", "loss", "told"),
    [("link_geometry", 0.01, False), ("link_geometry", 0.4, True), ("joint_eccentricity", 0.01, True)],
)
def test_slight_gain_keeps_no_link_explained_by_tolerances(robot: RobotDescription, name, loss, told) -> None:
    assert _is_worth_reporting(Effect.at(robot, name, ELBOW), False, loss) is told


def test_link_costs_the_same_whole_or_by_parameter(robot: RobotDescription) -> None:
    link = Effect.at(robot, "link_geometry", ELBOW, values=[1e-3, 0.0, 0.0, 0.0, 0.02, 0.0])
    fit = start_of(robot, scattered(robot, 3, ROWS), (link,), 3).with_tolerances(Scales())
    resting = link.with_values(np.zeros(6))
    whole, numbers = (
        resting.with_free_amounts((0, 1, 4)),
        [resting.with_free_amounts((number,)) for number in (0, 1, 4)],
    )
    at_once, in_parts = (CauseSets(fit, [Candidate(one, 0.0, 1) for one in some], 4.0) for some in ([whole], numbers))
    assert at_once.of((0,)).net_evidence == pytest.approx(in_parts.of((0, 1, 2)).net_evidence, abs=1e-3)


def test_intervals_are_independent_of_instrument_distance() -> None:
    robot, rng = desk_arm(), np.random.default_rng([7, 10])
    motion, ratio = scattered(robot, 3, ROWS), Effect.at(robot, "joint_scale", ELBOW, values=[0.02])
    x = Simulation(robot, (ratio,), None, made(robot, rng)).positions(motion) + 5e-6 * rng.normal(size=(ROWS, 3))
    widths = []
    for away_m in (0.0, 10.0):
        recording = measured(robot, motion, x + np.array([0.0, away_m, 0.0]))
        start = aligned(Observations.of(recording, Simulation(robot)), Simulation(robot))
        fit = start.with_causes([ratio]).with_tolerances(Scales())
        widths.append(np.sqrt(np.diag(fit.covariance))[6:])
    np.testing.assert_allclose(widths[1], widths[0], rtol=0.02)


def test_links_of_roughly_made_arm_are_not_named() -> None:
    robot, rng = desk_arm(), np.random.default_rng([4, 46])
    sizes = [np.append(1.8e-3 * rng.normal(size=3), np.radians(0.36) * rng.normal(size=3)) for _ in robot.joints]
    pairs = zip(robot.joints, sizes, strict=True)
    made = tuple(Effect.at(robot, "link_geometry", joint, values=size) for joint, size in pairs)
    motion = walk(robot, 4, 200)
    x = Simulation(robot, (), None, made).positions(motion) + 3e-4 * rng.normal(size=(200, 3))
    recording = measured(robot, motion, x)
    file = conclusion(diagnose(recording, Simulation(robot), only=("joint_offset", "link_geometry")))
    assert (file.causes, file.verdict == "explained") == ((), False)
    assert file.tolerances is not None
    assert 0.1 < file.tolerances.angle_deg.value < 1.0
