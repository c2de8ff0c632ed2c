from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rough_arms import ROUGH, rough_arm

from kbmaps import ChainBelief, ChainParameters, ChainTolerances, NonFiniteError, RigidLearner, SettingError, ShapeError

seeds = st.integers(0, 2**32 - 1)
SLIGHT = ChainTolerances(axes=1e-4, points=1e-4, zeros=1e-4, tool=1e-4, base_rotation=1e-4)


@given(seed=seeds, first=st.integers(1, 39))
def test_belief_plus_new_pairs_equals_joint_fit(seed, first):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng, "RRRR", SLIGHT)
    q, x = arm.pairs(rng, 40, 1e-4)
    at_once, before = RigidLearner(arm.nominal, SLIGHT), RigidLearner(arm.nominal, SLIGHT)
    # Stated noisier than they are, so that by chance no part of them contradicts the chain.
    at_once.learn(q, x, 3e-4)
    before.learn(q[:first], x[:first], 3e-4)
    after = RigidLearner(arm.nominal, SLIGHT, before.belief)
    after.learn(q[first:], x[first:], 3e-4)
    claimed = at_once.estimate(q)
    np.testing.assert_allclose(after.predict(q), claimed.x, rtol=0, atol=0.1 * claimed.sigma.min())
    np.testing.assert_allclose(after.estimate(q).sigma, claimed.sigma, rtol=0.02)


@given(seed=seeds)
def test_new_tool_is_learnt_from_three_exact_pairs(seed):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng)
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 60))
    after = RigidLearner(arm.nominal, ROUGH, learner.belief.with_other_tool(0.2))
    moved = replace(arm, real=arm.real.with_tool([0.1, -0.1, 0.15]))
    after.learn(*moved.pairs(rng, 3))
    assert moved.error(after, rng) < 1e-6


def test_tool_change_frees_a_fixed_tool():
    rng = np.random.default_rng(5)
    tolerances = replace(ROUGH, tool=0.0)
    arm = rough_arm(rng, tolerances=tolerances)
    learner = RigidLearner(arm.nominal, tolerances)
    learner.learn(*arm.pairs(rng, 60))
    after = RigidLearner(arm.nominal, tolerances, learner.belief.with_other_tool(0.2))
    moved = replace(arm, real=arm.real.with_tool([0.1, 0.0, 0.1]))
    after.learn(*moved.pairs(rng, 5))
    assert moved.error(after, rng) < 1e-5


def test_tool_change_widens_only_the_tool_covariance():
    rng = np.random.default_rng(6)
    arm = rough_arm(rng)
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 60, 0.005))
    before, after = learner.belief, learner.belief.with_other_tool(0.2)
    added = after.covariance - before.covariance
    tool = before.parameters.tool
    expected = np.zeros_like(added)
    expected[tool, tool] = 0.04 * np.eye(3)
    np.testing.assert_allclose(added, expected, rtol=0, atol=1e-12)


def test_learner_with_given_prior_round_trips_through_bytes():
    rng = np.random.default_rng(7)
    arm = rough_arm(rng)
    q, x = arm.pairs(rng, 50, 0.005)
    before = RigidLearner(arm.nominal, ROUGH)
    before.learn(q[:30], x[:30])
    learner = RigidLearner(arm.nominal, ROUGH, before.belief.with_other_tool(0.1))
    learner.learn(q[30:], x[30:])
    copy = RigidLearner.from_bytes(learner.to_bytes())
    np.testing.assert_array_equal(copy.estimate(q).sigma, learner.estimate(q).sigma)


def test_belief_without_pairs_equals_the_tolerances():
    arm = rough_arm(np.random.default_rng(8))
    learner = RigidLearner(arm.nominal, ROUGH)
    expected = learner.belief.parameters.standard_deviations(ROUGH)
    np.testing.assert_allclose(np.sqrt(np.diag(learner.belief.covariance)), expected)


@pytest.mark.parametrize("wrong", [0.0, -0.1, np.inf, np.nan])
def test_a_tool_change_of_no_size_is_refused(wrong):
    arm = rough_arm(np.random.default_rng(9))
    with pytest.raises(SettingError, match="tolerance must be finite and greater than 0"):
        RigidLearner(arm.nominal, ROUGH).belief.with_other_tool(wrong)


def test_a_prior_of_another_chain_is_refused():
    rng = np.random.default_rng(10)
    long, short = rough_arm(rng), rough_arm(rng, "RRR")
    with pytest.raises(ShapeError, match="mean"):
        RigidLearner(long.nominal, ROUGH, RigidLearner(short.nominal, ROUGH).belief)


def test_a_belief_that_is_not_finite_is_refused():
    parameters = ChainParameters(rough_arm(np.random.default_rng(11)).nominal)
    with pytest.raises(NonFiniteError, match="root"):
        ChainBelief(parameters, np.zeros(parameters.size), np.full((parameters.size, 1), np.nan))


@pytest.mark.parametrize("told", [None, 0.002])
def test_belief_noise_matches_scatter_of_the_pairs(told):
    rng = np.random.default_rng(3)
    arm = rough_arm(rng)
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 200, 0.005), told)
    assert learner.belief.noise == pytest.approx(0.005, rel=0.1)


def test_belief_noise_survives_bytes_and_tool_change():
    rng = np.random.default_rng(4)
    arm = rough_arm(rng)
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 50, 0.005))
    noise = learner.belief.noise
    assert ChainBelief.from_bytes(learner.belief.to_bytes()).noise == noise
    assert learner.belief.with_other_tool(0.2).noise == noise


def test_mixed_belief_covariance_includes_distance_between_means():
    parameters = ChainParameters(rough_arm(np.random.default_rng(21), "RRR").nominal)
    rng = np.random.default_rng(22)
    near, far = (
        ChainBelief(parameters, mean, 0.01 * rng.normal(size=(parameters.size, 5)))
        for mean in 0.01 * rng.normal(size=(2, parameters.size))
    )
    found = near.with_mixture_covariance([near, far], [0.75, 0.25])
    apart = far.mean - near.mean
    expected = 0.75 * near.covariance + 0.25 * (far.covariance + np.outer(apart, apart))
    np.testing.assert_allclose(found.covariance, expected, atol=1e-12)
    np.testing.assert_array_equal(found.mean, near.mean)
