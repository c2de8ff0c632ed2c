"""Readings in whole ticks are recognised, with their share of the noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from planted_cases import SIGMA_M, desk_arm, measured, walk

from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.instrument import instrument_factor, reshaped
from bodyschema.diagnosis.fit.observations import Observations, encoder_steps
from bodyschema.effects import Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

TICK_RAD = 2.0 * np.pi / 4096
# A coarser encoder: its readings add about as much noise as the instrument has.
COARSE_RAD = 2.0 * np.pi / 512


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return desk_arm()


def rounded(q: FloatArray, tick: float) -> FloatArray:
    return tick * np.round(q / tick)


@pytest.mark.parametrize("tick", [TICK_RAD, COARSE_RAD, np.radians(0.1)])
def test_the_tick_of_rounded_readings_is_found(robot, tick) -> None:
    np.testing.assert_allclose(encoder_steps(rounded(walk(robot, 1).q, tick)), tick, rtol=1e-6)


def test_readings_that_are_not_rounded_have_no_tick(robot) -> None:
    np.testing.assert_array_equal(encoder_steps(walk(robot, 1).q), 0.0)


def test_each_joint_has_its_own_tick(robot) -> None:
    q = walk(robot, 1).q.copy()
    q[:, 1], q[:, 2] = rounded(q[:, 1], TICK_RAD), rounded(q[:, 2], COARSE_RAD)
    np.testing.assert_allclose(encoder_steps(q), [0.0, TICK_RAD, COARSE_RAD, 0.0], rtol=1e-6)


def test_joint_read_at_few_positions_has_no_tick(robot) -> None:
    q = np.repeat(rounded(walk(robot, 1).q[:15], TICK_RAD), 20, axis=0)
    np.testing.assert_array_equal(encoder_steps(q), 0.0)


def noisy(robot: RobotDescription, factor: float, tick: float, seed: int) -> Observations:
    """Return observations with `factor` times the stated noise, from encoders that read whole ticks."""
    motion = walk(robot, seed, 400)
    noise = factor * SIGMA_M * np.random.default_rng([seed, 1]).normal(size=(len(motion), 3))
    x = Simulation(robot).positions(motion) + noise
    read = dataclasses.replace(motion, q=rounded(motion.q, tick)) if tick else motion
    return Observations.of(measured(robot, read, x), Simulation(robot))


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0, 4.0])
def test_instrument_noise_is_separated_from_encoder_rounding(robot, factor) -> None:
    found = [instrument_factor(aligned(noisy(robot, factor, COARSE_RAD, seed), Simulation(robot))) for seed in range(5)]
    assert np.exp(np.mean(np.log(found))) == pytest.approx(factor, rel=0.15)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_residual_matches_rounding_plus_scaled_instrument_noise(robot, factor) -> None:
    observations = noisy(robot, factor, COARSE_RAD, 1)
    found = instrument_factor(aligned(observations, Simulation(robot)))
    fit = aligned(observations.with_factor(found), Simulation(robot))
    assert fit.noise.sigma == pytest.approx(1.0, abs=0.1)


def test_rounding_covariance_matches_propagated_tick_variance(robot) -> None:
    observations = noisy(robot, 1.0, COARSE_RAD, 1)
    simulation, motion = Simulation(robot), observations.motion
    rng = np.random.default_rng(3)
    offs = COARSE_RAD * rng.uniform(-0.5, 0.5, (400, *motion.q.shape))
    shifts = [simulation.positions(dataclasses.replace(motion, q=motion.q + off)) for off in offs]
    spread = np.var(shifts, axis=0).sum(axis=1)
    ratio = np.trace(observations.rounding, axis1=1, axis2=2) / spread
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)


def test_without_ticks_the_stated_noise_is_kept(robot) -> None:
    assert instrument_factor(aligned(noisy(robot, 3.0, 0.0, 1), Simulation(robot))) == 1.0


def test_noise_of_another_shape_than_stated_is_seen(robot) -> None:
    motion = walk(robot, 2, 400)
    x = Simulation(robot).positions(motion) + SIGMA_M * np.random.default_rng(5).normal(size=(400, 3))
    recording = dataclasses.replace(measured(robot, motion, x), cov=None)
    stated = Observations.of(recording, Simulation(robot))
    found = reshaped(aligned(stated, Simulation(robot)))
    assert found is not None
    # A stereo camera is stated to see depth least exactly.
    longest = [np.sqrt(np.median(np.linalg.cond(one.stated))) for one in (stated, found)]
    assert longest[0] > 4.0 > 1.5 > longest[1]


def test_noise_of_the_stated_shape_is_left_alone(robot) -> None:
    assert reshaped(aligned(noisy(robot, 3.0, 0.0, 1), Simulation(robot))) is None
