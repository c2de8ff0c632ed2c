"""What single readings scatter is not taken for a joint's memory of its way; a memory still is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from planted_cases import ELBOW, desk_arm, measured, motion_of

from diagnosis.alignment import aligned
from diagnosis.fit import Fit
from diagnosis.held_out import Blocks, block_p_value
from diagnosis.observations import Observations
from diagnosis.scatter import beside_scatter
from effects import Effect, Motion, Simulation
from interfaces.robot import RobotDescription

ROWS, SIGMA_M, SCATTER_RAD = 1200, 5e-5, np.radians(0.04)
# Probabilities of no memory at all.
HARDLY, CLEARLY = 1e-3, 1e-4
SEEDS = range(5)


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return desk_arm()


def slow_way(robot: RobotDescription, rng: np.random.Generator) -> Motion:
    """From pair to pair the joints move by about as much as their readings scatter, to and fro."""
    speeds, phases = rng.uniform(0.01, 0.02, len(robot.joints)), rng.uniform(0.0, 6.0, len(robot.joints))
    shares = 0.5 + 0.03 * np.sin(speeds * np.arange(ROWS)[:, None] + phases)
    return motion_of(robot.lower + shares * (robot.upper - robot.lower))


def fit_of(robot: RobotDescription, seed: int, *effects: Effect) -> Fit:
    """The simulation without effects, laid on readings that scatter."""
    rng = np.random.default_rng([seed, 21])
    motion = slow_way(robot, rng)
    x = Simulation(robot, effects).positions(motion) + SIGMA_M * rng.normal(size=(ROWS, 3))
    read = dataclasses.replace(motion, q=motion.q + SCATTER_RAD * rng.normal(size=motion.q.shape))
    simulation = Simulation(robot)
    return aligned(Observations.of(measured(robot, read, x), simulation), simulation)


def remembers(robot: RobotDescription, name: str) -> Effect:
    values = {"backlash": {"width_rad": 0.1 * SCATTER_RAD}, "settling": {"fraction": 0.1}}
    return Effect.at(robot, name, ELBOW, values=values[name])


def chance(fit: Fit, effect: Effect, *, beside: bool) -> float:
    columns = fit.weighted(fit.run.columns(effect)[:, :, effect.amounts])
    return block_p_value(fit, beside_scatter(fit, effect, columns) if beside else columns, Blocks.cut(ROWS))


@pytest.mark.parametrize("name", ["backlash", "settling"])
def test_the_scatter_of_readings_looks_like_a_memory_of_the_way_and_is_told_from_one(robot, name) -> None:
    fits, effect = [fit_of(robot, seed) for seed in SEEDS], remembers(robot, name)
    assert np.median([chance(fit, effect, beside=False) for fit in fits]) < CLEARLY
    assert min(chance(fit, effect, beside=True) for fit in fits) > HARDLY


@pytest.mark.parametrize("seed", SEEDS)
def test_a_play_of_several_times_the_scatter_is_clearly_seen_beside_it(robot, seed) -> None:
    play = Effect.at(robot, "backlash", ELBOW, values={"width_rad": 5.0 * SCATTER_RAD})
    assert chance(fit_of(robot, seed, play), play, beside=True) < CLEARLY


def test_what_has_no_memory_is_left_as_it_is(robot) -> None:
    fit, offset = fit_of(robot, 0), Effect.at(robot, "joint_offset", ELBOW, values=[0.001])
    columns = fit.weighted(fit.run.columns(offset)[:, :, offset.amounts])
    np.testing.assert_array_equal(beside_scatter(fit, offset, columns), columns)
