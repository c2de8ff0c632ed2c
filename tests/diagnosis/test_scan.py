"""Gain of a hypothesis with its moment, period or width, before any refit."""

from __future__ import annotations

import numpy as np
import pytest
from chance import successes
from planted_cases import BASE, ELBOW, SHOULDER, desk_arm, start_of, surveyed_arm, walk

from bodyschema.diagnosis.search.scan import Candidate, Scan
from bodyschema.effects import Effect
from bodyschema.robot.description import RobotDescription

CHANCE = 1e-4
SEEDS = range(20)
JUMP_ROW = 140


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return desk_arm()


def scanned(robot: RobotDescription, planted: Effect, seed: int) -> Candidate:
    """Return the effect as the scan recovers it from its name and place alone."""
    candidate = Scan(start_of(robot, walk(robot, seed), (planted,), seed)).candidate(
        Effect.at(robot, planted.name, planted.where, planted.source)
    )
    assert candidate is not None
    return candidate


SMALL = (
    ("joint_offset", ELBOW, None, [0.002]),
    ("joint_scale", SHOULDER, None, [0.002]),
    ("joint_eccentricity", BASE, None, [0.001, -0.001]),
    ("joint_ripple", SHOULDER, None, [0.001, 0.001, 9.0]),
    ("joint_coupling", ELBOW, BASE, [0.001]),
    ("encoder_jump", ELBOW, None, [0.002, 35.1]),
    ("link_geometry", ELBOW, None, [3e-4, 0.0, 3e-4, 0.001, 0.001, 0.001]),
    ("camera_moved", None, None, [3e-4, 3e-4, 0.0, 5e-4, 0.0, 5e-4, 35.1]),
    ("camera_refocused", None, None, [0.002, 35.1]),
    ("thermal_drift", None, None, [5e-4, 2e-4, 0.0, 30.0]),
    ("lens_distortion", None, None, [0.005, 0.0]),
)


@pytest.mark.parametrize(("name", "where", "source", "values"), SMALL, ids=[row[0] for row in SMALL])
def test_small_effect_gain_is_twice_the_likelihood_rise(robot, name, where, source, values) -> None:
    planted = Effect.at(robot, name, where, source, values=values)
    start = start_of(robot, walk(robot, 3), (planted,), 3)
    candidate = Scan(start).candidate(planted)
    assert candidate is not None
    refitted = start.with_causes([candidate.effect])
    assert candidate.gain > 20.0
    assert candidate.gain == pytest.approx(2.0 * (refitted.log_likelihood - start.log_likelihood), rel=0.03, abs=0.5)


@pytest.mark.parametrize("free", [(0,), (1, 5)])
def test_scan_frees_only_the_changed_link_parameters(free) -> None:
    arm, values = surveyed_arm(), np.array([3e-3, 2e-3, 0.0, 0.0, 0.0, 0.02])
    planted = Effect.at(arm, "link_geometry", ELBOW, values=values).with_free_amounts(free)
    found = scanned(arm, planted, 3).effect
    assert found.free == free
    assert list(found.table()) == ["effect", "where", *(planted.parameters[k].name for k in free)]


@pytest.mark.parametrize("name", ["joint_offset", "encoder_jump", "joint_ripple", "camera_moved"])
def test_large_effect_gain_is_within_25_percent(robot, name) -> None:
    at = {"joint_offset": (ELBOW, [0.05]), "encoder_jump": (ELBOW, [0.05, 35.1])} | {
        "joint_ripple": (SHOULDER, [0.02, 0.02, 9.0]),
        "camera_moved": (None, [0.01, 0.0, 0.01, 0.01, 0.0, 0.02, 35.1]),
    }
    where, values = at[name]
    planted = Effect.at(robot, name, where, values=values)
    start = start_of(robot, walk(robot, 3), (planted,), 3)
    candidate = Scan(start).candidate(planted)
    assert candidate is not None
    risen = 2.0 * (start.with_causes([candidate.effect]).log_likelihood - start.log_likelihood)
    assert candidate.gain == pytest.approx(risen, rel=0.25)


@pytest.mark.parametrize(
    ("name", "where", "amounts"),
    [
        ("encoder_jump", ELBOW, [0.03]),
        ("tool_slip", None, [0.004, 0.003, -0.004]),
        ("camera_moved", None, [0.005, 0.0, 0.003, 0.01, 0.0, 0.01]),
        ("camera_refocused", None, [0.01]),
    ],
)
def test_event_time_is_found_between_the_right_rows(robot, name, where, amounts) -> None:
    clock = walk(robot, 4).clock
    t0 = clock[JUMP_ROW] - 0.2
    found = scanned(robot, Effect.at(robot, name, where, values=[*amounts, t0]), 4)
    assert clock[JUMP_ROW - 1] < found.effect.value("t0") <= clock[JUMP_ROW]


@pytest.mark.soak
def test_faint_jump_time_intervals_have_their_stated_coverage(robot) -> None:
    clock = walk(robot, 0).clock
    half = 0.5 * (clock[1] - clock[0])
    t0 = 0.5 * (clock[JUMP_ROW - 1] + clock[JUMP_ROW])
    planted = Effect.at(robot, "encoder_jump", ELBOW, values=[0.0015, t0])
    intervals = np.array([scanned(robot, planted, seed).interval for seed in SEEDS])
    assert (intervals[:, 0] < intervals[:, 1]).any()
    held = (intervals[:, 0] - half < t0) & (t0 < intervals[:, 1] + half)
    assert held.sum() >= successes(CHANCE, len(SEEDS), 0.95)


@pytest.mark.parametrize("cycles", [2.0, 8.0, 12.4, 50.0, 81.0])
def test_scan_recovers_ripple_cycles_per_turn(robot, cycles) -> None:
    found = scanned(robot, Effect.at(robot, "joint_ripple", SHOULDER, values=[0.006, -0.004, cycles]), 6)
    # The grid's step next to the best one: a sixtieth of the period that changes the phase by one over the range.
    step = 2.0 * np.pi / np.ptp(walk(robot, 6).q[:, 1]) / 60.0
    assert found.effect.value("cycles_per_turn") == pytest.approx(cycles, abs=3.0 * step)


@pytest.mark.parametrize("width", [0.004, 0.02, 0.08])
def test_a_play_is_found_with_its_width(robot, width) -> None:
    planted = Effect.at(robot, "backlash", SHOULDER, values=[width])
    start = start_of(robot, walk(robot, 6), (planted,), 6)
    candidate = Scan(start).candidate(Effect.at(robot, "backlash", SHOULDER))
    assert candidate is not None
    assert candidate.effect.value("width_rad") == pytest.approx(width, rel=0.2)
    assert start.with_causes([candidate.effect]).causes[0].value("width_rad") == pytest.approx(width, rel=0.05)


def test_scan_without_a_cause_matches_refit_without_it(robot) -> None:
    truth = [
        Effect.at(robot, "joint_offset", SHOULDER, values=[0.004]),
        Effect.at(robot, "joint_scale", ELBOW, values=[0.01]),
    ]
    fit = start_of(robot, walk(robot, 4), tuple(truth), 4).with_causes(truth)
    asked = [Effect.at(robot, name, ELBOW) for name in ("joint_scale", "joint_eccentricity", "joint_ripple")]
    cause = fit.causes[1]
    here = Scan(fit, fit.causes).without(cause).candidates(asked)
    refitted = Scan(fit.without(cause)).candidates(asked)
    np.testing.assert_allclose([c.gain for c in here], [c.gain for c in refitted], rtol=0.02)
