"""Amounts are recovered within their stated uncertainty, and outliers do not matter."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from chance import chi_square, successes
from planted_cases import BASE, ELBOW, SHOULDER, at_rest, desk_arm, observed, start_of, walk

from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.fit import Fit, improved
from bodyschema.diagnosis.fit.observations import Observations, stereo_covariances
from bodyschema.diagnosis.fit.tangent import solved
from bodyschema.diagnosis.search.scan import Scan
from bodyschema.effects import Effect, Simulation
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

SEEDS = range(40)
# Of a bound that a right build breaks by chance.
CHANCE = 1e-4
JUMP_RAD = 0.3


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return desk_arm()


def planted(robot: RobotDescription) -> tuple[Effect, ...]:
    return (
        Effect.at(robot, "joint_offset", ELBOW, values=[0.03]),
        Effect.at(robot, "joint_scale", SHOULDER, values=[-0.02]),
        Effect.at(robot, "joint_eccentricity", BASE, values=[0.02, -0.01]),
    )


def amounts(fit: Fit) -> FloatArray:
    return np.concatenate([effect.values[effect.amounts] for effect in fit.causes])


def covariance(fit: Fit) -> FloatArray:
    """Return the covariance of the causes' amounts alone."""
    first = fit.covariance.shape[0] - len(amounts(fit))
    return fit.covariance[first:, first:]


def refitted(robot: RobotDescription, observations: Observations) -> Fit:
    start = aligned(observations, Simulation(robot))
    return start.with_causes([at_rest(effect) for effect in planted(robot)])


def with_outliers(clean: Observations, rows: np.ndarray) -> Observations:
    x = clean.x.copy()
    x[rows] += np.random.default_rng(9).normal(0.0, 0.2, (len(rows), 3))
    return dataclasses.replace(clean, x=x)


@pytest.fixture(scope="module")
def fits(robot) -> list[Fit]:
    truth = planted(robot)
    return [start_of(robot, walk(robot, seed), truth, seed).with_causes([at_rest(e) for e in truth]) for seed in SEEDS]


def test_amount_intervals_have_their_stated_coverage(robot, fits) -> None:
    truth = np.concatenate([effect.values for effect in planted(robot)])
    held = sum(np.abs(amounts(fit) - truth) <= 1.959964 * np.sqrt(np.diag(covariance(fit))) for fit in fits)
    assert (held >= successes(CHANCE, len(fits), 0.95)).all()


def test_covariance_is_neither_too_small_nor_too_large(robot, fits) -> None:
    truth = np.concatenate([effect.values for effect in planted(robot)])
    total = sum((amounts(f) - truth) @ np.linalg.solve(covariance(f), amounts(f) - truth) for f in fits)
    low, high = chi_square([CHANCE, 1.0 - CHANCE], len(truth) * len(fits))
    assert low < total < high


SHAPED = {
    "thermal_drift": (None, [0.004, -0.003, 0.005, 30.0], 40.0),
    "joint_ripple": (SHOULDER, [0.01, -0.01, 9.0], 9.15),
    "settling": (ELBOW, [0.2, 0.5], 0.4),
}


@pytest.mark.parametrize(
    "name", ["settling", *(pytest.param(name, marks=pytest.mark.soak) for name in SHAPED if name != "settling")]
)
def test_shape_parameter_intervals_have_their_stated_coverage(robot, name) -> None:
    where, values, off = SHAPED[name]
    truth = Effect.at(robot, name, where, values=values)
    held = 0
    for seed in SEEDS[:20]:
        start = start_of(robot, walk(robot, seed), (truth,), seed)
        fit = start.with_causes([truth.with_values(np.array([*values[:-1], off]))])
        (cause,) = fit.causes
        place = fit.places(cause)[-1]
        held += abs(cause.values[-1] - values[-1]) <= 1.959964 * np.sqrt(fit.covariance[place, place])
    assert held >= successes(CHANCE, 20, 0.95)


def test_estimated_noise_matches_the_recording_s_noise(fits) -> None:
    squares = np.mean([fit.noise.sigma**2 for fit in fits])
    # Each fit has three coordinates a trusted row less its amounts: 9 of camera and marker, 4 of the causes.
    coordinates = 3 * int(fits[0].observations.trusted.sum())
    dof = len(fits) * (coordinates - 13)
    low, high = chi_square([CHANCE, 1.0 - CHANCE], dof) / (len(fits) * coordinates)
    assert low < squares < high


@pytest.mark.parametrize("ends", [[], [0], [-1], [0, -1]], ids=["inside", "first row", "last row", "both ends"])
def test_ten_percent_outliers_hardly_change_the_amounts(robot, ends) -> None:
    clean = observed(robot, walk(robot, 5), planted(robot), 5)
    n = len(clean)
    inside = np.random.default_rng(6).choice(np.arange(1, n - 1), n // 10 - len(ends), replace=False)
    rows = np.append(inside, np.array(ends, dtype=int) % n)
    before, after = refitted(robot, clean), refitted(robot, with_outliers(clean, rows))
    moved = amounts(after) - amounts(before)
    distance = moved @ np.linalg.solve(covariance(before), moved)
    # A share s of the rows less moves the amounts by about s / (1 - s) of their variance.
    assert distance < chi_square(1.0 - CHANCE, len(moved)) / 9.0


@pytest.mark.parametrize("ends", [[], [-1]], ids=["inside", "last row"])
def test_scattered_outliers_get_low_weights(robot, ends) -> None:
    clean = observed(robot, walk(robot, 5), planted(robot), 5)
    n = len(clean)
    inside = np.random.default_rng(6).choice(np.arange(1, n - 1), n // 10 - len(ends), replace=False)
    rows = np.append(inside, np.array(ends, dtype=int) % n)
    weights = refitted(robot, with_outliers(clean, rows)).noise.weights
    others = np.setdiff1d(np.arange(1, n), rows)
    assert weights[rows].max() < 0.5 < weights[others].min()


@pytest.fixture(scope="module")
def jumped(robot) -> Fit:
    motion = walk(robot, 7)
    t0 = motion.clock[210] - 0.1
    return start_of(robot, motion, (Effect.at(robot, "encoder_jump", SHOULDER, values=[JUMP_RAD, t0]),), 7)


def test_rows_after_a_jump_are_not_outliers(jumped) -> None:
    assert jumped.noise.weights[210:].mean() > 0.95


def test_jump_is_found_from_fit_without_it(robot, jumped) -> None:
    candidate = Scan(jumped).candidate(Effect.at(robot, "encoder_jump", SHOULDER))
    assert candidate is not None
    found = jumped.with_causes([candidate.effect]).causes[0]
    clock = jumped.observations.motion.clock
    assert clock[209] < found.value("t0") < clock[210]
    assert found.value("jump_rad") == pytest.approx(JUMP_RAD, abs=0.002)


def triangulated(pixels: FloatArray, calibration: StereoCalibration) -> FloatArray:
    """Return the point (3,) [m] of (ul, vl, ur, vr) [px], with the mean row of both images."""
    ul, vl, ur, vr = pixels
    cx, cy = calibration.principal_point_px
    z = calibration.focal_px * calibration.baseline_m / (ul - ur)
    return np.array([(ul - cx) * z, (0.5 * (vl + vr) - cy) * z, calibration.focal_px * z]) / calibration.focal_px


def test_stereo_covariances_match_numerical_triangulation_derivatives(robot) -> None:
    calibration = robot.calibration
    assert calibration is not None
    x = np.random.default_rng(8).uniform([-0.4, -0.3, 0.4], [0.4, 0.3, 1.6], (20, 3))
    step = 1e-4
    for point, stated in zip(x, stereo_covariances(x, calibration), strict=True):
        pixels = calibration.project(point)
        moved = [
            (triangulated(pixels + e, calibration) - triangulated(pixels - e, calibration)) / (2.0 * step)
            for e in step * np.eye(4)
        ]
        by_pixel = np.stack(moved, axis=1)
        expected = calibration.pixel_sigma**2 * by_pixel @ by_pixel.T
        np.testing.assert_allclose(stated, expected, rtol=1e-5, atol=1e-5 * np.trace(expected))


def test_time_constant_uncertainty_is_independent_of_time_unit(robot) -> None:
    way, halves = walk(robot, 5), []
    assert way.t is not None
    for unit in (1.0, 1e3):
        motion = dataclasses.replace(way, t=way.t * unit)
        drift = Effect.at(robot, "thermal_drift", values=[0.003, 0.0, 0.001, 30.0 * unit])
        fit = start_of(robot, motion, (drift,), 5).with_causes([drift])
        halves.append(np.sqrt(fit.covariance[-1, -1]) / unit)
    assert halves[1] == pytest.approx(halves[0], rel=1e-3)


def test_barely_observed_time_constant_has_large_uncertainty(robot) -> None:
    way = walk(robot, 5)
    assert way.t is not None
    # By the end of the recording hardly more than a straight line has been seen.
    long = 3.0 * float(way.t[-1])
    drift = Effect.at(robot, "thermal_drift", values=[0.001, 0.0, 0.0, long])
    fit = start_of(robot, way, (drift,), 5).with_causes([drift])
    assert np.sqrt(fit.covariance[-1, -1]) > 0.5 * long


def test_hopeless_fit_is_given_up_within_three_steps(robot, monkeypatch) -> None:
    truth = Effect.at(robot, "joint_offset", SHOULDER, values=[0.02])
    other = start_of(robot, walk(robot, 1), (truth,), 1).with_unfitted_causes(
        [Effect.at(robot, "joint_scale", SHOULDER)]
    )
    best = improved(other).log_likelihood
    assert improved(other, best).log_likelihood == best
    taken, step = [], Fit.step
    monkeypatch.setattr(Fit, "step", lambda fit, tangent=None: taken.append(fit) or step(fit, tangent))
    improved(other, best + 1000.0)
    assert len(taken) <= 3


def test_distant_start_among_outliers_still_converges(robot) -> None:
    clean = observed(robot, walk(robot, 5), planted(robot), 5)
    rows = np.random.default_rng(6).choice(len(clean), len(clean) // 10, replace=False)
    best = refitted(robot, with_outliers(clean, rows))
    far = best.with_unfitted_causes([e.with_values(np.asarray(e.values) + 0.1) for e in best.causes])
    assert improved(far, best.log_likelihood - 1.0).log_likelihood > best.log_likelihood - 1.0


def test_prior_disfavours_large_undetermined_amounts(robot) -> None:
    start = start_of(robot, walk(robot, 1), (), 1)
    # Guided torque-free: no weight bends a joint.
    none = Effect.at(robot, "joint_compliance", ELBOW)
    large = none.with_values(np.array([20.0 * parameter.usual for parameter in none.parameters]))
    one, other = (start.with_unfitted_causes([effect]) for effect in (none, large))
    np.testing.assert_array_equal(one.run.measured, other.run.measured)
    assert one.log_likelihood - other.log_likelihood > 1.5


def test_kept_derivatives_lead_to_the_same_fit(robot) -> None:
    full = refitted(robot, observed(robot, walk(robot, 6), planted(robot), 6))
    kept = full.with_unfitted_causes(full.causes[1:])
    own = dataclasses.replace(kept, tangent=None)
    assert kept.tangent is not None
    # Differences of this size decide nothing.
    assert abs(improved(kept).log_likelihood - improved(own).log_likelihood) < 0.3


def test_estimated_loss_of_cause_matches_a_refit(robot) -> None:
    full = refitted(robot, observed(robot, walk(robot, 6), planted(robot), 6))
    for cause in full.causes:
        assert full.loss(cause) == pytest.approx(full.log_likelihood - full.without(cause).log_likelihood, rel=0.1)


def test_normal_equations_of_equal_columns_share_the_amount() -> None:
    assert solved(np.ones((2, 2)), np.ones(2)) == pytest.approx([0.5, 0.5])
