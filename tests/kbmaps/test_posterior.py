from __future__ import annotations

import numpy as np
import pytest
from planted_chains import random_q
from rough_arms import ROUGH, rough_arm

from kbmaps import ChainPosterior, DegenerateDataError, RecursiveRigidLearner, RigidLearner, SettingError, ShapeError
from kbmaps.chains.parameters import ChainParameters


@pytest.mark.parametrize("kind", [RigidLearner, RecursiveRigidLearner])
@pytest.mark.parametrize("kinds", ["RRRRRR", "RPRRR"])
@pytest.mark.parametrize("pairs", [0, 3, 60])
def test_roots_and_floor_reproduce_the_learner_sigma(kind, kinds, pairs):
    rng = np.random.default_rng(3)
    arm = rough_arm(rng, kinds)
    learner = kind(arm.nominal, ROUGH)
    if pairs:
        learner.learn(*arm.pairs(rng, pairs, 0.01), 0.01)
    q = random_q(rng, kinds, 20, 80)
    posterior = ChainPosterior.of(learner, noise=0.01)
    variances = np.square(posterior.roots(q)).sum(axis=2) + posterior.floor**2
    np.testing.assert_allclose(np.sqrt(variances), learner.estimate(q).sigma, rtol=1e-6)


def test_roots_reproduce_learner_sigma_with_infinite_tolerances():
    rng = np.random.default_rng(4)
    arm = rough_arm(rng)
    wide = type(ROUGH)(axes=0.05, points=0.015, tool=np.inf, base_rotation=np.inf, base_translation=np.inf)
    learner = RigidLearner(arm.nominal, wide)
    learner.learn(*arm.pairs(rng, 100, 0.01), 0.01)
    q = random_q(rng, arm.kinds, 20, 80)
    roots = ChainPosterior.of(learner).roots(q)
    np.testing.assert_allclose(np.sqrt(np.square(roots).sum(axis=2)), learner.estimate(q).sigma, rtol=1e-4)


def test_recursive_covariance_matches_batch_covariance():
    rng = np.random.default_rng(5)
    arm = rough_arm(rng)
    pairs = arm.pairs(rng, 200, 0.005)
    batch, recursive = RigidLearner(arm.nominal, ROUGH), RecursiveRigidLearner(arm.nominal, ROUGH)
    batch.learn(*pairs, 0.005)
    recursive.learn(*pairs, 0.005)
    std = np.sqrt(np.diag(batch.covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(recursive.covariance)), std, rtol=0.05)


def test_recursive_covariance_without_pairs_equals_tolerances():
    arm = rough_arm(np.random.default_rng(6))
    std = ChainParameters(arm.nominal).standard_deviations(ROUGH)
    covariance = RecursiveRigidLearner(arm.nominal, ROUGH).covariance
    np.testing.assert_allclose(covariance, np.diag(np.square(std)), atol=1e-15)


@pytest.mark.parametrize("kind", [RigidLearner, RecursiveRigidLearner])
def test_noise_is_estimated_unless_given(kind):
    rng = np.random.default_rng(7)
    arm = rough_arm(rng)
    learner = kind(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 300, 0.02))
    assert ChainPosterior.of(learner).noise == pytest.approx(0.02, rel=0.1)
    assert ChainPosterior.of(learner, noise=0.001).noise == 0.001


def test_model_misfit_is_floor_and_adds_to_noise():
    rng = np.random.default_rng(8)
    arm = rough_arm(rng)
    q, x = arm.pairs(rng, 500, 0.005)
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(q, x, 0.003)
    posterior = ChainPosterior.of(learner)
    assert posterior.floor == pytest.approx(0.004, rel=0.15)
    assert posterior.noise == pytest.approx(0.005, rel=0.1)


def test_batch_posterior_without_pairs_is_refused():
    arm = rough_arm(np.random.default_rng(9))
    with pytest.raises(DegenerateDataError):
        ChainPosterior.of(RigidLearner(arm.nominal, ROUGH))


def test_invalid_arguments_are_refused():
    arm = rough_arm(np.random.default_rng(10))
    size = ChainParameters(arm.nominal).size
    change, covariance = np.zeros(size), np.eye(size)
    for noise, floor in ((0.0, 0.0), (np.nan, 0.0), (0.01, -1.0), (0.01, np.inf)):
        with pytest.raises(SettingError):
            ChainPosterior(arm.nominal, change, covariance, noise=noise, floor=floor)
    with pytest.raises(ShapeError):
        ChainPosterior(arm.nominal, change[1:], covariance, noise=0.01)
    with pytest.raises(ShapeError):
        ChainPosterior(arm.nominal, change, covariance[1:], noise=0.01)
