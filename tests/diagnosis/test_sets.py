"""Compare sets of causes about several fits: the same set is worth the same about each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from planted_cases import (
    BASE,
    ELBOW,
    SHOULDER,
    WRIST,
    desk_arm,
    measured,
    motion_of,
    scattered,
    start_of,
    surveyed_arm,
    walk,
)

from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.background import Scales
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.net_evidence import choice_counts
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.search.hypotheses import Hypotheses
from bodyschema.diagnosis.search.joint_selection import (
    _Linearisation,
    alternatives_to_tolerances,
    estimated_tolerances,
    together,
)
from bodyschema.diagnosis.search.scan import Candidate
from bodyschema.diagnosis.search.sets import CauseSets
from bodyschema.effects import Effect, Simulation
from bodyschema.robot.description import RobotDescription

NOISE_M, ROWS = 3e-4, 60
NAMES = ("joint_offset", "joint_scale")


def fit_of(robot: RobotDescription, hidden: Effect, away_m: Sequence[float] = (0.0, 0.0, 0.0)) -> Fit:
    """Return the fit without any cause of an arm with one, seen by an instrument that far from its nominal place."""
    motion = scattered(robot, 1, ROWS)
    x = Simulation(robot, (hidden,)).positions(motion) + np.array(away_m)
    x += NOISE_M * np.random.default_rng(1).normal(size=x.shape)
    recording = measured(robot, motion, x)
    return aligned(Observations.of(recording, Simulation(robot)), Simulation(robot)).with_tolerances(Scales())


def sets(fit: Fit, cause: Effect) -> CauseSets:
    return CauseSets(fit, [Candidate(cause, 0.0, 1)], 0.0)


def test_set_worth_is_independent_of_reference_fit() -> None:
    robot = desk_arm()
    hidden = Effect.at(robot, "backlash", SHOULDER, values=[0.03])
    without = fit_of(robot, hidden, (3.0, -3.0, 2.0))
    complete = without.with_causes([hidden])
    assert complete.noise.sigma < 0.5 * without.noise.sigma
    net_evidences = [sets(fit, hidden).of(()).net_evidence for fit in (without, complete)]
    assert net_evidences[0] == pytest.approx(net_evidences[1], abs=3.0)


def test_outliers_explained_by_a_cause_favour_its_set() -> None:
    robot = surveyed_arm()
    jump = Effect.at(robot, "encoder_jump", ELBOW, values={"jump_rad": 0.1, "t0": 0.25 * (ROWS - 5.5)})
    without = fit_of(robot, jump)
    assert (without.noise.weights < 0.5).sum() == 6
    assert (
        sets(without.with_causes([jump]), jump).of((0,)).net_evidence > sets(without, jump).of(()).net_evidence + 20.0
    )


def test_cause_with_impossible_sign_leaves_its_set() -> None:
    robot = surveyed_arm()
    hidden = Effect.at(robot, "backlash", SHOULDER, values=[-0.02])
    assert not hidden.is_valid
    compared = sets(fit_of(robot, hidden), hidden)
    assert [one.chosen for one in compared.hill_climbed([(0,)])] == [()]


def rough(robot: RobotDescription, seed: int, angle: float, *causes: Effect) -> Fit:
    """Return the fit without any cause of an arm whose links are off by 0.1 mm and some angle, to 0.02 mm."""
    rng = np.random.default_rng([11, seed])
    links = [np.concatenate([1e-4 * rng.normal(size=3), angle * rng.normal(size=3)]) for _ in robot.joints]
    parts = zip(robot.joints, links, strict=True)
    made = (Effect.at(robot, "link_geometry", joint, values=values) for joint, values in parts)
    motion = motion_of(rng.uniform(0.8 * robot.lower, 0.8 * robot.upper, (150, len(robot.joints))))
    x = Simulation(robot, causes, None, tuple(made)).positions(motion) + 2e-5 * rng.normal(size=(150, 3))
    return aligned(Observations.of(measured(robot, motion, x), Simulation(robot)), Simulation(robot))


@pytest.mark.parametrize("seed", range(3))
def test_set_fit_recovers_from_too_large_tolerances(seed) -> None:
    robot = desk_arm()
    places = zip((SHOULDER, ELBOW, WRIST), (0.1, -0.1, 0.1), strict=True)
    offsets = [Effect.at(robot, "joint_offset", joint, values=[size]) for joint, size in places]
    start = rough(robot, seed, 5e-4, *offsets)
    hypotheses = [Effect.at(robot, "joint_offset", joint) for joint in robot.joints]
    afar = _Linearisation(start.with_tolerances(Scales(10.0, 10.0, 10.0)), hypotheses, ())
    near = start.with_causes(offsets).with_tolerances(Scales()).with_tolerances(Scales())
    matching = afar.refitted(afar._sets.of(afar._sets.matching(offsets)))
    assert afar._worth(matching) == pytest.approx(afar._worth(near), abs=3.0)


@pytest.mark.parametrize(("bent", "stays"), [(0.0, False), (0.1, True)])
@pytest.mark.parametrize("seed", range(3))
def test_only_strongly_bent_link_stays_in_rough_arm(seed, bent, stays) -> None:
    robot = desk_arm()
    link = Effect.at(robot, "link_geometry", WRIST, values=[0.0, 0.0, 0.0, bent, -bent, bent])
    hypotheses = [Effect.at(robot, "link_geometry", joint) for joint in robot.joints]
    fit = (
        rough(robot, seed, 5e-3, *([link] if bent else []))
        .with_tolerances(Scales())
        .with_causes([link.with_free_amounts((3, 4, 5))])
    )
    place = _Linearisation(fit.with_tolerances(Scales()), hypotheses, ())
    place = _Linearisation(place.refitted(place.current), hypotheses, ())
    assert (place.without_weakest() is None) is stays


@pytest.mark.parametrize(("arm", "angle"), [(desk_arm, 5e-3), (desk_arm, 8e-3), (surveyed_arm, 1e-3)])
@pytest.mark.parametrize("seed", range(6))
def test_a_roughly_made_arm_has_no_cause(seed, arm, angle) -> None:
    start = rough(arm(), seed, angle)
    hypotheses = Hypotheses.of(start.simulation, start.observations).effects
    assert together(start, hypotheses).causes == ()


def bent(seed: int, angle: float) -> tuple[Fit, Sequence[Effect]]:
    """Return the start of an arm made to 0.06° with one link bent by an angle about each axis, and the hypotheses."""
    robot = desk_arm()
    start = rough(robot, seed, 1e-3, Effect.at(robot, "link_geometry", WRIST, values=[0, 0, 0, angle, -angle, angle]))
    return start, Hypotheses.of(start.simulation, start.observations).effects


@pytest.mark.parametrize("seed", range(4))
def test_bent_link_is_named_over_implausible_tolerances(seed) -> None:
    # Without it angles would have to be made five times as roughly.
    assert [cause.where for cause in together(*bent(seed, 0.012)).causes] == [WRIST]


@pytest.mark.parametrize("seed", range(4))
def test_alternative_to_large_tolerances_has_a_probability(seed) -> None:
    start, hypotheses = bent(seed, 0.008)
    fit = start.with_tolerances(Scales())
    found = alternatives_to_tolerances(fit.with_tolerances(estimated_tolerances(fit).scales), hypotheses)
    assert found[0][0].where == WRIST
    assert 0.1 < found[0][1] < 0.9
    assert all(share < 0.02 for _, share in found[1:])


@pytest.mark.parametrize("seed", range(3))
def test_camera_scale_is_named_over_large_tolerances(seed) -> None:
    robot = desk_arm()
    start = rough(robot, seed, 1e-3, Effect.at(robot, "camera_scale", values=[0.03]))
    hypotheses = Hypotheses.of(start.simulation, start.observations).effects
    assert [cause.name for cause in together(start, hypotheses).causes] == ["camera_scale"]


def test_camera_scale_absorbed_by_tolerances_is_an_alternative() -> None:
    robot = desk_arm()
    start = rough(robot, 2, 3e-3, Effect.at(robot, "camera_scale", values=[0.02]))
    hypotheses = Hypotheses.of(start.simulation, start.observations).effects
    fit = start.with_tolerances(Scales())
    found = alternatives_to_tolerances(fit.with_tolerances(estimated_tolerances(fit).scales), hypotheses)
    assert found[0][0].name == "camera_scale"
    assert found[0][1] > 0.1  # the share from which a report leaves its verdict open


def test_tolerances_of_a_workshop_are_no_cause_instead() -> None:
    start, hypotheses = bent(1, 0.0)
    fit = start.with_tolerances(Scales())
    assert alternatives_to_tolerances(fit.with_tolerances(estimated_tolerances(fit).scales), hypotheses) == []


@pytest.mark.parametrize("seed", [0, 1, 3, 4])
def test_small_link_shift_is_found_despite_tolerances(seed) -> None:
    robot = surveyed_arm()
    shift = Effect.at(robot, "link_geometry", WRIST, values=[5e-4, -5e-4, 5e-4, 0.0, 0.0, 0.0])
    lens = Effect.at(robot, "camera_focal", values=[2e-3])
    start = start_of(robot, walk(robot, seed), (shift, lens), seed)
    found = together(start, Hypotheses.of(start.simulation, start.observations).effects)
    assert {(cause.name, cause.where) for cause in found.causes} == {("link_geometry", WRIST), ("camera_focal", None)}


@pytest.mark.parametrize("seed", range(4))
def test_submillimetre_camera_displacement_is_found_despite_tolerances(seed) -> None:
    robot = surveyed_arm()
    pose = Effect.at(robot, "camera_pose", values=4e-4 * np.random.default_rng([3, seed]).normal(size=6))
    start = start_of(robot, walk(robot, seed, 400), (pose,), seed)
    found = together(start, Hypotheses.of(start.simulation, start.observations).effects)
    assert [cause.name for cause in found.causes] == ["camera_pose"]


@pytest.mark.parametrize("seed", range(3))
def test_refitted_set_has_self_consistent_tolerances(seed) -> None:
    place = _Linearisation(rough(desk_arm(), seed, 8e-3).with_tolerances(Scales()), [], ())
    fit = place.refitted(place.current)
    scales = fit.background.scales
    assert scales is not None
    assert scales.angles == pytest.approx(estimated_tolerances(fit).scales.angles, rel=0.3)


def test_least_needed_cause_is_left_out(monkeypatch) -> None:
    robot = desk_arm()
    offsets = [Effect.at(robot, "joint_offset", joint, values=[0.02]) for joint in (ELBOW, WRIST)]
    place = _Linearisation(rough(robot, 0, 1e-3, *offsets).with_tolerances(Scales()).with_causes(offsets), offsets, ())
    gains = {ELBOW: 5.0, WRIST: 1.0}
    monkeypatch.setattr(
        _Linearisation, "_worth", lambda self, fit: self.current.net_evidence + gains[fit.causes[0].where]
    )
    fewer = place.without_weakest()
    assert fewer is not None
    assert [cause.where for cause in fewer.causes] == [ELBOW]


@pytest.fixture(scope="module")
def named() -> CauseSets:
    """Return sets of zeros, ratios and links, each number of a link by itself, and jumps at one moment."""
    robot = surveyed_arm()
    names = ("joint_offset", "joint_scale", "link_geometry", "encoder_jump")
    effects = [Effect.at(robot, name, joint) for name in names for joint in robot.joints]
    links = [replace(one, free=(k,)) for one in effects if one.kind.in_parts for k in one.amounts]
    others = [one for one in effects if not one.kind.in_parts]
    fit = fit_of(robot, others[0])
    return CauseSets(fit, [Candidate(one, 0.0, 1, 7 if one.kind.begins else 1) for one in (*others, *links)], 4.0)


@pytest.mark.parametrize("seed", range(5))
def test_group_cost_is_the_difference_of_set_costs(named, seed) -> None:
    rng = np.random.default_rng(seed)
    chosen = tuple(np.flatnonzero(rng.random(len(named.effects)) < 0.3).tolist())
    absent = [group for group in named._groups if not set(group) & set(chosen)]
    present = [group for group in named._groups if set(group) <= set(chosen)]
    more = [named._cost((*chosen, *group)) - named._cost(chosen) for group in absent]
    less = [named._cost(chosen) - named._cost(tuple(k for k in chosen if k not in group)) for group in present]
    np.testing.assert_allclose(named._costs_of(chosen, absent, are_in=False), more, atol=1e-9)
    np.testing.assert_allclose(named._costs_of(chosen, present, are_in=True), less, atol=1e-9)


def test_the_names_of_a_set_have_no_order(named) -> None:
    zero, scale = (next(k for k, one in enumerate(named.effects) if one.name == name) for name in NAMES)
    assert named._cost((zero, scale)) == pytest.approx(named._cost((zero,)) + named._cost((scale,)) - np.log(2.0))


def test_link_parameter_choices_have_total_probability_one() -> None:
    ways = choice_counts(Effect.at(desk_arm(), "link_geometry", BASE))
    assert (1.0 / ways[1:]).sum() == pytest.approx(1.0)


def test_pure_shifts_are_likelier_than_mixed_link_parameters() -> None:
    ways = choice_counts(Effect.at(desk_arm(), "link_geometry", BASE))
    assert ways[0b000111] == ways[0b111000] < 0.1 * ways[0b100011]


def test_camera_pose_adds_a_prior_scale_parameter() -> None:
    robot = surveyed_arm()
    fit = fit_of(robot, Effect.at(robot, "camera_scale", values=[0.03]))
    sizes = [
        len(sets(fit, Effect.at(robot, name)).of((0,)).logs) - len(Scales()) for name in ("camera_pose", "camera_scale")
    ]
    assert sizes == [1, 0]
