from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, random_map, random_q

from kbmaps import ExactLearner, NonFiniteError, SettingError, ShapeError, SupportSet

seeds = st.integers(0, 2**32 - 1)


def filled(kinds: str, q: np.ndarray, **settings_) -> SupportSet:
    support = SupportSet(bases_for(kinds), **settings_)
    for row in q:
        support.add(row)
    return support


@given(seed=seeds, kinds=st.text("RP", min_size=1, max_size=5))
def test_learnt_configurations_are_explained_within_threshold(seed, kinds):
    q = random_q(np.random.default_rng(seed), kinds, 40, 80)
    support = filled(kinds, q)
    assert support.unexplained(q).max() <= support.threshold + 1e-9


def test_far_away_nothing_is_explained():
    rng = np.random.default_rng(1)
    support = filled("R" * 7, 0.1 * rng.normal(size=(50, 7)))
    opposite = np.full(7, math.pi)
    assert support.unexplained(opposite) > 0.95
    assert support.unexplained(np.zeros(7)) < 0.05


def test_an_empty_set_explains_nothing():
    support = SupportSet(bases_for("RR"))
    assert support.unexplained([0.0, 0.0]) == 1.0
    np.testing.assert_array_equal(support.unexplained(np.zeros((3, 2))), 1.0)


@given(seed=seeds, kinds=st.text("RP", min_size=1, max_size=4))
def test_the_fraction_is_the_gaussian_process_variance(seed, kinds):
    rng = np.random.default_rng(seed)
    support = filled(kinds, random_q(rng, kinds, 20, 80), noise=0.01, threshold=0.02)
    weights = random_map(rng, bases_for(kinds)).weights
    unit = lambda q: weights(q) / np.linalg.norm(weights(q), axis=1, keepdims=True)  # noqa: E731
    kept, test = unit(support.configurations), random_q(rng, kinds, 10, 120)
    cross = unit(test) @ kept.T
    gram = kept @ kept.T + 0.01 * np.eye(len(kept))
    expected = 1 - np.einsum("ns,ns->n", cross, np.linalg.solve(gram, cross.T).T)
    np.testing.assert_allclose(support.unexplained(test), expected, rtol=0, atol=1e-9)


@given(seed=seeds)
def test_one_configuration_is_judged_as_in_a_batch(seed):
    rng = np.random.default_rng(seed)
    support = filled("RPR", random_q(rng, "RPR", 30, 80))
    q = random_q(rng, "RPR", 5, 170)
    np.testing.assert_allclose(support.unexplained(q), [support.unexplained(row) for row in q], rtol=0, atol=1e-9)
    np.testing.assert_allclose(support.spread(q), [support.spread(row) for row in q], rtol=1e-6, atol=1e-6)


def test_a_full_set_thins_out_and_goes_on():
    rng = np.random.default_rng(2)
    q = random_q(rng, "RRR", 500, 80)
    support = filled("RRR", q, capacity=8, threshold=1e-3)
    assert support.size <= 8
    assert support.threshold > 1e-3
    assert support.unexplained(q).max() <= support.threshold + 1e-9


def test_claimed_spread_matches_errors_of_exact_fits():
    """Errors of maps sampled from the prior, after an exact fit, have the spread that the support set predicts."""
    rng = np.random.default_rng(3)
    kinds, noise_std = "RRR", 0.05
    bases = bases_for(kinds)
    prior = random_map(rng, bases)
    q, test = random_q(rng, kinds, 12, 80), random_q(rng, kinds, 40, 80)
    support = filled(kinds, q, noise=1e-3, threshold=1.1e-3)
    claimed = support.spread(test)
    ratios = []
    for _ in range(100):
        truth = type(prior)(bases, prior.net + rng.normal(size=prior.net.shape))
        learner = ExactLearner(prior)
        learner.learn(q, truth.predict(q) + noise_std * rng.normal(size=(12, 3)))
        ratios.append((learner.solve(noise_std**2).map.predict(test) - truth.predict(test)) / claimed[:, None])
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, rel=0.1)


def test_nan_is_refused_and_changes_nothing():
    support = filled("RR", np.zeros((1, 2)))
    with pytest.raises(NonFiniteError):
        support.add([0.0, math.nan])
    with pytest.raises(NonFiniteError):
        support.unexplained([math.inf, 0.0])
    with pytest.raises(ShapeError):
        support.add([0.0])
    assert support.size == 1


@pytest.mark.parametrize("wrong", [{"capacity": 1}, {"noise": 0.0}, {"threshold": 1.0}])
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(SettingError):
        SupportSet(bases_for("R"), **wrong)
