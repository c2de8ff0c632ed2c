from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, random_chain, random_map, random_q

from kbmaps import ExactLearner, KernelLearner, Memory, SettingError

seeds = st.integers(0, 2**32 - 1)
KINDS = "RPR"


def stream(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    q = random_q(rng, KINDS, n, 80)
    return q, random_chain(rng, KINDS).positions(q) + 0.01 * rng.normal(size=(n, 3))


@given(seed=seeds, window=st.integers(1, 40), pieces=st.lists(st.integers(1, 25), min_size=1, max_size=6))
def test_windowed_kernel_learner_equals_fresh_on_last_pairs(seed, window, pieces):
    rng = np.random.default_rng(seed)
    q, x = stream(rng, sum(pieces))
    windowed, fresh = KernelLearner(bases_for(KINDS), memory=Memory(window)), KernelLearner(bases_for(KINDS))
    for part in np.split(np.arange(len(q)), np.cumsum(pieces)[:-1]):
        windowed.learn(q[part], x[part])
        windowed.predict(q[part])
    fresh.learn(q[-window:], x[-window:])
    test = random_q(rng, KINDS, 20, 80)
    np.testing.assert_array_equal(windowed.predict(test), fresh.predict(test))
    assert windowed.pairs == len(q)
    assert windowed.kept == min(len(q), window)


@given(seed=seeds, window=st.integers(1, 40), pieces=st.lists(st.integers(1, 60), min_size=1, max_size=8))
def test_windowed_exact_learner_equals_fresh_on_last_pairs(seed, window, pieces):
    rng = np.random.default_rng(seed)
    prior = random_map(rng, bases_for(KINDS))
    q, x = stream(rng, sum(pieces))
    weight = rng.uniform(0.5, 2.0, len(q))
    windowed, fresh = ExactLearner(prior, memory=Memory(window)), ExactLearner(prior)
    for part in np.split(np.arange(len(q)), np.cumsum(pieces)[:-1]):
        windowed.learn(q[part], x[part], weight[part])
    fresh.learn(q[-window:], x[-window:], weight[-window:])
    found, expected = windowed.solve(0.1), fresh.solve(0.1)
    np.testing.assert_allclose(found.map.net, expected.map.net, rtol=0, atol=1e-10)
    assert found.log_evidence == pytest.approx(expected.log_evidence, rel=1e-9, abs=1e-6)


def test_pairs_leaving_the_window_leave_the_sums():
    rng = np.random.default_rng(6)
    prior = random_map(rng, bases_for(KINDS))
    q, x = stream(rng, 1700)
    windowed, fresh = ExactLearner(prior, memory=Memory(1200)), ExactLearner(prior)
    for part in np.array_split(np.arange(1700), 17):
        windowed.learn(q[part], x[part])
        windowed.solve(0.1)
    fresh.learn(q[-1200:], x[-1200:])
    np.testing.assert_allclose(windowed.solve(0.1).map.net, fresh.solve(0.1).map.net, rtol=0, atol=1e-12)


def test_a_window_stays_exact_over_a_long_run():
    rng = np.random.default_rng(5)
    prior = random_map(rng, bases_for(KINDS))
    q, x = stream(rng, 20_000)
    windowed, fresh = ExactLearner(prior, memory=Memory(200)), ExactLearner(prior)
    for part in np.array_split(np.arange(20_000), 300):
        windowed.learn(q[part], x[part])
    fresh.learn(q[-200:], x[-200:])
    np.testing.assert_allclose(windowed.solve(0.1).map.net, fresh.solve(0.1).map.net, rtol=0, atol=1e-12)


@given(seed=seeds, forgetting=st.floats(0.8, 1.0), n=st.integers(1, 150), precision=st.floats(1e-2, 10.0))
def test_forgetting_is_least_squares_weighted_by_age(seed, forgetting, n, precision):
    rng = np.random.default_rng(seed)
    prior = random_map(rng, bases_for(KINDS))
    q, x = stream(rng, n)
    weighted = ExactLearner(prior)
    weighted.learn(q, x, np.maximum(forgetting ** np.arange(n - 1, -1, -1.0), 1e-300))
    expected = weighted.solve(precision).map.predict(q)
    exact = ExactLearner(prior, memory=Memory(forgetting=forgetting))
    kernel = KernelLearner(prior.bases, prior, precision=precision, memory=Memory(forgetting=forgetting))
    for part in np.array_split(np.arange(n), 4):
        exact.learn(q[part], x[part])
        kernel.learn(q[part], x[part])
    np.testing.assert_allclose(exact.solve(precision).map.predict(q), expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(kernel.predict(q), expected, rtol=0, atol=1e-11)


@given(seed=seeds, forgetting=st.floats(0.9, 1.0))
def test_learners_agree_on_noise_and_evidence_with_forgetting(seed, forgetting):
    rng = np.random.default_rng(seed)
    prior = random_map(rng, bases_for(KINDS))
    q, x = stream(rng, 100)
    exact = ExactLearner(prior, memory=Memory(forgetting=forgetting))
    kernel = KernelLearner(prior.bases, prior, precision=0.1, memory=Memory(forgetting=forgetting))
    exact.learn(q, x)
    kernel.learn(q, x)
    solution = exact.solve(0.1)
    assert kernel.noise == pytest.approx(solution.noise_std, rel=1e-7)
    assert kernel.log_evidence == pytest.approx(solution.log_evidence, rel=1e-7, abs=1e-6)


def test_noise_estimate_is_unbiased_under_forgetting():
    rng = np.random.default_rng(1)
    chain = random_chain(rng, KINDS)
    q = random_q(rng, KINDS, 3000, 80)
    learner = ExactLearner(chain.to_kbmap(bases_for(KINDS)), memory=Memory(forgetting=0.99))
    learner.learn(q, chain.positions(q) + 0.01 * rng.normal(size=(3000, 3)))
    assert learner.solve("evidence").noise_std == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize("learner_kind", ["window", "forgetting"])
def test_a_changed_arm_is_followed(learner_kind):
    rng = np.random.default_rng(2)
    old, new = random_chain(rng, KINDS), random_chain(rng, KINDS)
    q = random_q(rng, KINDS, 600, 80)
    memory = Memory(100) if learner_kind == "window" else Memory(forgetting=0.96)
    learner = KernelLearner(bases_for(KINDS), old, memory=memory)
    learner.learn(q[:300], old.positions(q[:300]))
    learner.learn(q[300:], new.positions(q[300:]))
    test = random_q(rng, KINDS, 100, 80)
    assert np.linalg.norm(learner.predict(test) - new.positions(test), axis=1).max() < 1e-3


def test_forgetting_stays_exact_over_a_long_run():
    rng = np.random.default_rng(3)
    prior = random_map(rng, bases_for(KINDS))
    n, forgetting = 20_000, 0.98
    q, x = stream(rng, n)
    long, weighted = ExactLearner(prior, memory=Memory(forgetting=forgetting)), ExactLearner(prior)
    for part in np.array_split(np.arange(n), 300):
        long.learn(q[part], x[part])
    last = slice(-2500, None)
    weighted.learn(q[last], x[last], forgetting ** np.arange(2499, -1, -1.0))
    np.testing.assert_allclose(long.solve(0.1).map.net, weighted.solve(0.1).map.net, rtol=0, atol=1e-12)


def test_unseen_directions_fade_to_the_prior():
    rng = np.random.default_rng(4)
    chain, prior = random_chain(rng, "RR"), random_chain(rng, "RR").to_kbmap(bases_for("RR"))
    learner, unaware = (ExactLearner(prior, memory=Memory(forgetting=0.5)) for _ in range(2))
    q = random_q(rng, "RR", 50, 80)
    learner.learn(q, chain.positions(q))
    same = np.tile([[0.3, -0.2]], (4000, 1))
    for each in (learner, unaware):
        each.learn(same, chain.positions(same))
    found, expected = learner.solve(1e-6).map, unaware.solve(1e-6).map
    np.testing.assert_allclose(found.predict(same[0]), chain.positions(same[0]), rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.net, expected.net, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "settings_", [{"window": 0}, {"forgetting": 0.0}, {"forgetting": 1.1}, {"forgetting": math.nan}]
)
def test_an_impossible_memory_is_refused(settings_):
    with pytest.raises(SettingError):
        Memory(**settings_)
