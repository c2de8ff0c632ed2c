"""Noise of single readings is not mistaken for a joint's hysteresis; real hysteresis is found."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from planted_cases import ELBOW, desk_arm, measured, motion_of

from bodyschema.diagnosis.assess.rivals import assessments
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.net_evidence import WorthSettings, evidence_gain
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.fit.scatter import instruments
from bodyschema.diagnosis.search.held_out import Blocks, block_p_value
from bodyschema.diagnosis.search.search import Search
from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.effects.catalogue.settling import Settling
from bodyschema.robot.description import RobotDescription

ROWS, SIGMA_M, SCATTER_RAD = 1200, 5e-5, np.radians(0.04)
# Probabilities of no memory at all.
HARDLY, CLEARLY = 1e-3, 1e-4
SEEDS = range(5)
PreparedFamily = Callable[[RobotDescription, np.random.Generator], Motion]


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return desk_arm()


def slow_way(robot: RobotDescription, rng: np.random.Generator) -> Motion:
    """Return a motion to and fro whose steps are about as large as the readings' noise."""
    speeds, phases = rng.uniform(0.01, 0.02, len(robot.joints)), rng.uniform(0.0, 6.0, len(robot.joints))
    shares = 0.5 + 0.03 * np.sin(speeds * np.arange(ROWS)[:, None] + phases)
    return motion_of(robot.lower + shares * (robot.upper - robot.lower))


def way_with_rests(robot: RobotDescription, rng: np.random.Generator) -> Motion:
    """Return a motion between postures by about a degree per row; every other move of each joint is a rest."""
    shares = 0.5 + 0.3 * rng.uniform(-1.0, 1.0, (ROWS // 40 + 2, len(robot.joints)))
    rests = rng.random(shares.shape) < 0.5
    for row in range(1, len(shares)):
        shares[row, rests[row]] = shares[row - 1, rests[row]]
    knots, rows = 40 * np.arange(len(shares)), np.arange(ROWS)
    between = np.stack([np.interp(rows, knots, column) for column in shares.T], axis=1)
    return motion_of(robot.lower + between * (robot.upper - robot.lower))


def poses(robot: RobotDescription, rng: np.random.Generator) -> Motion:
    """Return unrelated poses."""
    return motion_of(robot.lower + rng.uniform(0.2, 0.8, (ROWS, len(robot.joints))) * (robot.upper - robot.lower))


def fit_of(
    robot: RobotDescription,
    seed: int,
    *effects: Effect,
    way: PreparedFamily = slow_way,
    scatter_rad: float = SCATTER_RAD,
) -> Fit:
    """Return the simulation without effects, aligned to noisy readings."""
    rng = np.random.default_rng([seed, 21])
    motion = way(robot, rng)
    x = Simulation(robot, effects).positions(motion) + SIGMA_M * rng.normal(size=(ROWS, 3))
    read = dataclasses.replace(motion, q=motion.q + scatter_rad * rng.normal(size=motion.q.shape))
    simulation = Simulation(robot)
    return aligned(Observations.of(measured(robot, read, x), simulation), simulation)


def remembers(robot: RobotDescription, name: str) -> Effect:
    values = {"backlash": {"width_rad": 0.1 * SCATTER_RAD}, "settling": {"fraction": 0.1}}
    return Effect.at(robot, name, ELBOW, values=values[name])


def chance(fit: Fit, effect: Effect, *, beside: bool) -> float:
    columns = instruments(fit, effect) if beside else fit.weighted(fit.run.columns(effect)[:, :, effect.amounts])
    return block_p_value(fit, columns, Blocks.cut(ROWS))


@pytest.mark.parametrize("name", ["backlash", "settling"])
def test_reading_noise_is_distinguished_from_hysteresis(robot, name) -> None:
    fits, effect = [fit_of(robot, seed) for seed in SEEDS], remembers(robot, name)
    assert np.median([chance(fit, effect, beside=False) for fit in fits]) < CLEARLY
    assert min(chance(fit, effect, beside=True) for fit in fits) > HARDLY


@pytest.mark.parametrize("seed", SEEDS)
def test_backlash_of_five_times_the_scatter_is_detected(robot, seed) -> None:
    play = Effect.at(robot, "backlash", ELBOW, values={"width_rad": 5.0 * SCATTER_RAD})
    assert chance(fit_of(robot, seed, play), play, beside=True) < CLEARLY


@pytest.mark.parametrize("name", ["backlash", "settling"])
@pytest.mark.soak
def test_p_values_of_absent_hysteresis_are_calibrated(robot, name) -> None:
    """More than 4 of 80 p-values below 0.01 occur by chance in 1 of 700 such tests."""
    chances = []
    for seed in range(20):
        fit = fit_of(robot, seed, way=way_with_rests, scatter_rad=(0.2, 1.0, 3.0)[seed % 3] * SCATTER_RAD)
        for joint in robot.joints:
            effect = Effect.at(robot, name, joint, values=remembers(robot, name).values)
            chances.append(chance(fit, effect, beside=True))
    assert sum(p < 0.01 for p in chances) <= 4


@pytest.mark.parametrize("name", ["backlash", "settling"])
@pytest.mark.parametrize("way", [way_with_rests, poses])
def test_hysteresis_is_detected_across_rests_and_poses(robot, name, way) -> None:
    values = {
        "backlash": {"width_rad": 5.0 * SCATTER_RAD},
        "settling": {"fraction": 0.2 if way is way_with_rests else 0.01},
    }
    effect = Effect.at(robot, name, ELBOW, values=values[name])
    assert max(chance(fit_of(robot, seed, effect, way=way), effect, beside=True) for seed in SEEDS) < CLEARLY


def with_false_play(robot: RobotDescription, seed: int) -> tuple[Fit, Search]:
    """Return a fit with a backlash that the joint does not have; noisy readings make the likelihood favour it."""
    fit, search = fit_of(robot, seed), Search([Effect.at(robot, "backlash", ELBOW)], lambda _: None)
    false = fit.with_causes([Effect.at(robot, "backlash", ELBOW, values=[0.3 * SCATTER_RAD])])
    assert evidence_gain(2.0 * (false.log_likelihood - fit.log_likelihood), 1) > WorthSettings.named_nats
    return false, search


@pytest.mark.parametrize("seed", SEEDS)
def test_search_removes_backlash_due_to_reading_noise(robot, seed) -> None:
    false, search = with_false_play(robot, seed)
    assert not search.run(false).causes


@pytest.mark.parametrize("seed", SEEDS)
def test_backlash_due_to_reading_noise_is_not_sure(robot, seed) -> None:
    false, search = with_false_play(robot, seed)
    (assessment,) = assessments(false, search, Blocks.cut(ROWS), 0)
    assert assessment.probability < 0.9


class LagOfAnotherPackage(Settling):
    name = "lag_of_another_package"


def test_plugin_hysteresis_effect_uses_the_same_instruments(robot) -> None:
    lag = remembers(robot, "settling")
    other = dataclasses.replace(lag, kind=LagOfAnotherPackage())
    fit = fit_of(robot, 0)
    np.testing.assert_array_equal(instruments(fit, other), instruments(fit, lag))


def test_effect_without_memory_keeps_its_own_columns(robot) -> None:
    fit, offset = fit_of(robot, 0), Effect.at(robot, "joint_offset", ELBOW, values=[0.001])
    columns = fit.weighted(fit.run.columns(offset)[:, :, offset.amounts])
    np.testing.assert_array_equal(instruments(fit, offset), columns)
