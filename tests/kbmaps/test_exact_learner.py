from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, control_points_needed, random_chain, random_map, random_q

from kbmaps import BasisError, ExactLearner, JointBasis, NonFiniteError, SettingError, ShapeError, prediction_errors

seeds = st.integers(0, 2**32 - 1)
kinds = st.text("RP", min_size=1, max_size=3)
MIXED = ["RRPRR", "PPPRR", "RPRP", "PRRRR"]


def exactness_error(rng: np.random.Generator, joint_kinds: str, *, cluster_deg: float, times: int) -> float:
    """Return the largest error [m] within ±80° after times·3^R·2^P noise-free samples of a cluster around zero."""
    chain, prior = random_chain(rng, joint_kinds), random_chain(rng, joint_kinds)
    q = random_q(rng, joint_kinds, times * control_points_needed(joint_kinds), cluster_deg)
    learner = ExactLearner(prior.to_kbmap(bases_for(joint_kinds)), bases_for(joint_kinds, cluster_deg))
    learner.learn(q, chain.positions(q))
    test = random_q(rng, joint_kinds, 500, 80)
    return float(prediction_errors(learner.solve().map, test, chain.positions(test)).max())


@pytest.mark.parametrize("joints", [1, 2, 3, 4, 5])
def test_revolute_chain_is_recovered_from_minimum_samples(joints):
    assert exactness_error(np.random.default_rng(joints), "R" * joints, cluster_deg=80, times=1) < 1e-9


@pytest.mark.parametrize("joint_kinds", MIXED)
def test_mixed_chain_is_recovered_from_minimum_samples(joint_kinds):
    assert exactness_error(np.random.default_rng(11), joint_kinds, cluster_deg=80, times=1) < 1e-9


@pytest.mark.parametrize("joints", [1, 2, 3, 4, 5])
def test_small_cluster_of_twice_minimum_samples_recovers_chain(joints):
    assert exactness_error(np.random.default_rng(joints), "R" * joints, cluster_deg=20, times=2) < 1e-7


@pytest.mark.soak
@pytest.mark.parametrize("joints", [6, 7])
def test_six_and_seven_joints_recovered_from_minimum_samples(joints):
    assert exactness_error(np.random.default_rng(joints), "R" * joints, cluster_deg=80, times=1) < 1e-9


@pytest.mark.soak
@pytest.mark.parametrize("joints", [6, 7])
def test_six_and_seven_joints_recovered_from_small_cluster(joints):
    assert exactness_error(np.random.default_rng(joints), "R" * joints, cluster_deg=20, times=2) < 1e-5


@pytest.mark.soak
@pytest.mark.parametrize("joints", [2, 3, 4, 5])
def test_exactness_holds_for_fifty_random_chains(joints):
    worst = [exactness_error(np.random.default_rng(seed), "R" * joints, cluster_deg=80, times=1) for seed in range(50)]
    assert max(worst) < 1e-8


@given(seed=seeds, joint_kinds=kinds, share=st.floats(0.1, 1.0))
def test_too_few_pairs_give_solution_nearest_to_prior(seed, joint_kinds, share):
    rng = np.random.default_rng(seed)
    prior = random_map(rng, bases_for(joint_kinds))
    n = max(1, int(share * prior.size))
    q, x = random_q(rng, joint_kinds, n, 80), rng.normal(size=(n, 3))
    learner = ExactLearner(prior)
    learner.learn(q, x)
    design = prior.weights(q)
    nearest = np.linalg.pinv(design) @ (x - prior.predict(q))
    change = (learner.solve().map.net - prior.net).reshape(3, -1).T
    np.testing.assert_allclose(
        change, nearest, rtol=0, atol=1e-13 * np.linalg.cond(design) * np.abs(nearest).max() * 10
    )


@given(seed=seeds, copies=st.integers(2, 40))
def test_repeated_pairs_leave_minimum_norm_solution_unchanged(seed, copies):
    rng = np.random.default_rng(seed)
    prior = random_map(rng, bases_for("RR"))
    q, x = random_q(rng, "RR", 4, 80), rng.normal(size=(4, 3))
    once, often = ExactLearner(prior), ExactLearner(prior)
    once.learn(q, x)
    often.learn(np.tile(q, (copies, 1)), np.tile(x, (copies, 1)))
    condition = np.linalg.cond(prior.weights(q))
    np.testing.assert_allclose(often.solve().map.net, once.solve().map.net, rtol=0, atol=1e-11 * condition**2)


@given(seed=seeds, cuts=st.lists(st.integers(1, 400), max_size=6), precision=st.sampled_from([None, 1e-2, "evidence"]))
def test_learning_in_pieces_equals_learning_at_once(seed, cuts, precision):
    rng = np.random.default_rng(seed)
    prior = random_map(rng, bases_for("RRR"))
    q, x = random_q(rng, "RRR", 400, 80), rng.normal(size=(400, 3))
    at_once, in_pieces = ExactLearner(prior), ExactLearner(prior)
    at_once.learn(q, x)
    for part in np.split(np.arange(400), sorted(cuts)):
        in_pieces.learn(q[part], x[part])
    assert in_pieces.pairs == 400
    np.testing.assert_allclose(in_pieces.solve(precision).map.net, at_once.solve(precision).map.net, rtol=0, atol=1e-9)


@given(seed=seeds, precision=st.sampled_from([None, 1e-2, "evidence"]), pairs=st.sampled_from([10, 27, 300]))
def test_the_order_of_the_pairs_does_not_matter(seed, precision, pairs):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, "RRR")
    prior = random_chain(rng, "RRR").to_kbmap(bases_for("RRR"))
    q = random_q(rng, "RRR", pairs, 80)
    x = chain.positions(q) + 0.005 * rng.normal(size=(pairs, 3))
    order = rng.permutation(pairs)
    one, other = ExactLearner(prior), ExactLearner(prior)
    one.learn(q, x)
    other.learn(q[order], x[order])
    atol = 1e-7 * np.linalg.cond(prior.weights(q))
    np.testing.assert_allclose(one.solve(precision).map.net, other.solve(precision).map.net, rtol=0, atol=atol * 1e-3)


def test_pairs_one_at_a_time_equal_a_batch():
    rng = np.random.default_rng(1)
    prior = random_map(rng, bases_for("RR"))
    q, x = random_q(rng, "RR", 300, 80), rng.normal(size=(300, 3))
    batch, single = ExactLearner(prior), ExactLearner(prior)
    batch.learn(q, x)
    for row, position in zip(q, x, strict=True):
        single.learn(row, position)
    np.testing.assert_allclose(single.solve().map.net, batch.solve().map.net, rtol=0, atol=1e-12)


@given(seed=seeds, precision=st.floats(1e-4, 10.0), pairs=st.sampled_from([5, 27, 200]))
def test_ridge_solution_is_posterior_mean_around_prior(seed, precision, pairs):
    rng = np.random.default_rng(seed)
    prior = random_map(rng, bases_for("RRR"))
    q, x = random_q(rng, "RRR", pairs, 80), rng.normal(size=(pairs, 3))
    weight = rng.uniform(0.2, 5.0, pairs)
    learner = ExactLearner(prior)
    learner.learn(q, x, weight)
    design = prior.weights(q)
    normal = design.T @ (weight[:, None] * design) + precision * np.eye(prior.size)
    expected = np.linalg.solve(normal, design.T @ (weight[:, None] * (x - prior.predict(q))))
    change = (learner.solve(precision).map.net - prior.net).reshape(3, -1).T
    np.testing.assert_allclose(change, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("pairs", [15, 60])
def test_log_evidence_is_gaussian_likelihood_at_best_noise(pairs):
    rng = np.random.default_rng(4)
    prior = random_map(rng, bases_for("RRR"))
    q, x = random_q(rng, "RRR", pairs, 80), rng.normal(size=(pairs, 3))
    weight, precision = rng.uniform(0.5, 2.0, pairs), 0.3
    learner = ExactLearner(prior)
    learner.learn(q, x, weight)
    solution = learner.solve(precision)
    design = prior.weights(q)
    covariance = design @ design.T / precision + np.diag(1.0 / weight)
    errors = x - prior.predict(q)
    variance = np.einsum("no,no->", errors, np.linalg.solve(covariance, errors)) / (3 * pairs)
    _, log_determinant = np.linalg.slogdet(2 * math.pi * variance * covariance)
    assert solution.noise_std == pytest.approx(math.sqrt(variance), rel=1e-9)
    assert solution.log_evidence == pytest.approx(-1.5 * log_determinant - 1.5 * pairs, rel=1e-9)


@pytest.mark.parametrize("pairs", [20, 200])
def test_chosen_ridge_has_greatest_evidence_on_grid(pairs):
    rng = np.random.default_rng(6)
    chain, prior = random_chain(rng, "RRR"), random_chain(rng, "RRR").to_kbmap(bases_for("RRR"))
    q = random_q(rng, "RRR", pairs, 80)
    learner = ExactLearner(prior)
    learner.learn(q, chain.positions(q) + 0.01 * rng.normal(size=(pairs, 3)))
    chosen = learner.solve("evidence").log_evidence
    grid = [learner.solve(precision).log_evidence for precision in np.logspace(-6, 3, 40)]
    assert chosen >= max(grid) - 0.5


def held_out_ratio(seed: int) -> float:
    """Return the held-out error of the evidence's ridge over the best of a grid, with noisy pairs and a wrong prior."""
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, "RRRR")
    fixed = chain.fixed.copy()
    fixed[:, :3, 3] += 0.02 * rng.normal(size=(5, 3))
    prior = type(chain)(fixed, chain.axes, chain.prismatic).to_kbmap(bases_for("RRRR"))
    pairs = int(rng.integers(20, 250))
    q, test = random_q(rng, "RRRR", pairs, 80), random_q(rng, "RRRR", 400, 80)
    learner = ExactLearner(prior)
    learner.learn(q, chain.positions(q) + 0.005 * rng.normal(size=(pairs, 3)))
    truth = chain.positions(test)
    grid = [prediction_errors(learner.solve(p).map, test, truth).mean() for p in np.logspace(-4, 3, 15)]
    return prediction_errors(learner.solve("evidence").map, test, truth).mean() / min(grid)


def test_evidence_chooses_near_optimal_ridge():
    ratios = [held_out_ratio(seed) for seed in range(8)]
    assert sum(ratio <= 1.3 for ratio in ratios) >= 7


@pytest.mark.soak
def test_evidence_chooses_near_optimal_ridge_in_95_percent():
    ratios = [held_out_ratio(seed) for seed in range(200)]
    assert np.mean([ratio <= 1.3 for ratio in ratios]) >= 0.95


@pytest.mark.parametrize("pairs", [12, 100])
def test_rebased_learner_equals_fresh_one_with_new_prior(pairs):
    rng = np.random.default_rng(8)
    first, second = (random_map(rng, bases_for("RRR")) for _ in range(2))
    q, x = random_q(rng, "RRR", pairs, 80), rng.normal(size=(pairs, 3))
    moved, fresh = ExactLearner(first), ExactLearner(second)
    moved.learn(q, x)
    fresh.learn(q, x)
    moved.rebase(second)
    np.testing.assert_allclose(moved.solve(0.1).map.net, fresh.solve(0.1).map.net, rtol=0, atol=1e-10)


def test_solution_uses_the_bases_of_the_prior():
    rng = np.random.default_rng(9)
    prior = random_chain(rng, "RR").to_kbmap([JointBasis.bernstein(1.0)] * 2)
    learner = ExactLearner(prior, bases_for("RR"))
    learner.learn([0.1, 0.2], [0.0, 0.0, 0.0])
    assert learner.solve(0.1).map.bases == prior.bases


def test_the_noise_is_estimated():
    rng = np.random.default_rng(10)
    chain = random_chain(rng, "RRR")
    q = random_q(rng, "RRR", 400, 80)
    learner = ExactLearner(random_chain(rng, "RRR").to_kbmap(bases_for("RRR")))
    learner.learn(q, chain.positions(q) + 0.01 * rng.normal(size=(400, 3)))
    assert learner.solve().noise_std == pytest.approx(0.01, rel=0.1)
    assert learner.solve("evidence").noise_std == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("precision", [None, 0.1, "evidence"])
def test_without_pairs_the_solution_is_the_prior(precision):
    prior = random_map(np.random.default_rng(1), bases_for("RR"))
    solution = ExactLearner(prior).solve(precision)
    assert solution.map.digest == prior.digest
    assert solution.noise_std is None


def test_exact_prior_is_kept_by_evidence_solution():
    rng = np.random.default_rng(1)
    prior = random_chain(rng, "RR").to_kbmap(bases_for("RR"))
    learner = ExactLearner(prior)
    q = random_q(rng, "RR", 50, 80)
    learner.learn(q, prior.predict(q))
    np.testing.assert_allclose(learner.solve("evidence").map.net, prior.net, rtol=0, atol=1e-12)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_nan_is_refused_and_changes_nothing(bad):
    rng = np.random.default_rng(1)
    learner = ExactLearner(random_map(rng, bases_for("RR")))
    learner.learn(random_q(rng, "RR", 20, 80), rng.normal(size=(20, 3)))
    before = learner.solve().map.digest
    for q, x, weight in (
        ([0.0, bad], np.zeros(3), 1.0),
        (np.zeros(2), [0, bad, 0], 1.0),
        (np.zeros(2), np.zeros(3), bad),
    ):
        with pytest.raises(NonFiniteError):
            learner.learn(q, x, weight)
    assert (learner.pairs, learner.solve().map.digest) == (20, before)


def test_impossible_settings_and_shapes_are_refused():
    prior = random_map(np.random.default_rng(1), bases_for("RR"))
    learner = ExactLearner(prior)
    with pytest.raises(SettingError):
        learner.solve(0.0)
    with pytest.raises(SettingError):
        learner.solve(math.nan)
    with pytest.raises(SettingError, match="guess"):
        learner.solve("guess")  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="weight"):
        learner.learn([0.0, 0.0], [0.0, 0.0, 0.0], 0.0)
    with pytest.raises(ShapeError):
        learner.learn(np.zeros((3, 2)), np.zeros((2, 3)))
    with pytest.raises(ShapeError):
        learner.learn(np.zeros((3, 2)), np.zeros((3, 3)), np.ones(2))
    with pytest.raises(BasisError):
        learner.rebase(random_map(np.random.default_rng(1), bases_for("R")))
    assert learner.pairs == 0
