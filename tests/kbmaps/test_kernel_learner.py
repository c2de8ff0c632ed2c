from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, control_points_needed, random_chain, random_map, random_q
from rough_arms import rough_arm

from kbmaps import (
    DegenerateDataError,
    ExactLearner,
    KernelLearner,
    Memory,
    Model,
    ModelFormatError,
    NonFiniteError,
    SettingError,
    ShapeError,
)
from kbmaps.kernel.kernel_fit import ProductKernel

seeds = st.integers(0, 2**32 - 1)
kinds = st.text("RP", min_size=1, max_size=4)


def noisy_pairs(rng: np.random.Generator, joint_kinds: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    q = random_q(rng, joint_kinds, n, 80)
    return q, random_chain(rng, joint_kinds).positions(q) + 0.01 * rng.normal(size=(n, 3))


@given(seed=seeds, joint_kinds=kinds)
def test_kernel_is_inner_product_of_weight_vectors(seed, joint_kinds):
    rng = np.random.default_rng(seed)
    bases = bases_for(joint_kinds)
    kernel, kbmap = ProductKernel(bases), random_map(rng, bases)
    q, others = random_q(rng, joint_kinds, 5, 180), random_q(rng, joint_kinds, 7, 180)
    inner = kbmap.weights(q) @ kbmap.weights(others).T
    weights = kernel.joint_weights(q)
    np.testing.assert_allclose(kernel.between(weights, kernel.joint_weights(others)), inner, rtol=1e-11, atol=1e-10)
    np.testing.assert_allclose(kernel.diagonal(weights), np.diag(kernel.between(weights, weights)), rtol=1e-12)


@given(seed=seeds, joint_kinds=kinds, pairs=st.integers(1, 120), precision=st.floats(1e-6, 1e3))
def test_kernel_learner_equals_exact_learner_at_same_precision(seed, joint_kinds, pairs, precision):
    rng = np.random.default_rng(seed)
    q, x = noisy_pairs(rng, joint_kinds, pairs)
    sigma = rng.uniform(0.5, 2.0, pairs)
    prior = random_map(rng, bases_for(joint_kinds))
    exact, kernel = ExactLearner(prior), KernelLearner(prior.bases, prior, precision=precision)
    exact.learn(q, x, 1.0 / sigma**2)
    kernel.learn(q, x, sigma)
    test = random_q(rng, joint_kinds, 50, 80)
    np.testing.assert_allclose(
        kernel.predict(test), exact.solve(precision).map.predict(test), rtol=0, atol=1e-11 * max(1.0, 1e-3 / precision)
    )


@given(seed=seeds, joint_kinds=kinds, pairs=st.integers(2, 120), precision=st.floats(1e-3, 1e3))
def test_noise_and_evidence_match_the_exact_learner(seed, joint_kinds, pairs, precision):
    rng = np.random.default_rng(seed)
    q, x = noisy_pairs(rng, joint_kinds, pairs)
    prior = random_map(rng, bases_for(joint_kinds))
    exact, kernel = ExactLearner(prior), KernelLearner(prior.bases, prior, precision=precision)
    exact.learn(q, x)
    kernel.learn(q, x)
    solution = exact.solve(precision)
    assert kernel.log_evidence == pytest.approx(solution.log_evidence, rel=1e-9, abs=1e-6)
    assert kernel.noise == pytest.approx(solution.noise_std, rel=1e-7)
    assert kernel.prior_std == pytest.approx(solution.prior_std, rel=1e-7)


@given(seed=seeds, joint_kinds=kinds, pairs=st.integers(1, 60), precision=st.floats(1e-3, 10.0))
def test_predicted_variance_matches_control_point_posterior(seed, joint_kinds, pairs, precision):
    rng = np.random.default_rng(seed)
    q, x = noisy_pairs(rng, joint_kinds, pairs)
    prior = random_map(rng, bases_for(joint_kinds))
    learner = KernelLearner(prior.bases, prior, precision=precision)
    learner.learn(q, x, 1.0)
    design, test = prior.weights(q), random_q(rng, joint_kinds, 20, 80)
    covariance = np.linalg.inv(design.T @ design + precision * np.eye(prior.size))
    expected = np.einsum("np,pr,nr->n", prior.weights(test), covariance, prior.weights(test))
    variance = np.square(learner.estimate(test).sigma)
    np.testing.assert_allclose(variance, np.tile(expected[:, None], 3), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("joint_kinds", ["R", "RR", "RRR", "RRRR", "RRRRR", "RRPRR", "PPRR"])
def test_chain_is_recovered_from_minimum_noise_free_pairs(joint_kinds):
    rng = np.random.default_rng(len(joint_kinds))
    chain, prior = random_chain(rng, joint_kinds), random_chain(rng, joint_kinds)
    q = random_q(rng, joint_kinds, control_points_needed(joint_kinds), 80)
    learner = KernelLearner(bases_for(joint_kinds), prior, precision=None)
    learner.learn(q, chain.positions(q))
    test = random_q(rng, joint_kinds, 300, 80)
    assert np.linalg.norm(learner.predict(test) - chain.positions(test), axis=1).max() < 1e-7


@given(seed=seeds, joint_kinds=st.text("RP", min_size=2, max_size=4), share=st.floats(0.1, 0.5))
def test_without_precision_solution_is_nearest_to_prior(seed, joint_kinds, share):
    rng = np.random.default_rng(seed)
    prior = random_map(rng, bases_for(joint_kinds))
    n = max(1, int(share * prior.size))
    q, x = random_q(rng, joint_kinds, n, 80), rng.normal(size=(n, 3))
    exact, kernel = ExactLearner(prior), KernelLearner(prior.bases, prior, precision=None)
    exact.learn(q, x)
    kernel.learn(q, x)
    test = random_q(rng, joint_kinds, 20, 80)
    condition = np.linalg.cond(prior.weights(q))
    np.testing.assert_allclose(kernel.predict(test), exact.solve().map.predict(test), rtol=0, atol=1e-12 * condition**2)
    np.testing.assert_allclose(kernel.predict(q), x, rtol=0, atol=1e-12 * condition**2)


@given(seed=seeds, joint_kinds=kinds, precision=st.sampled_from([1e-2, "evidence"]))
def test_the_order_of_the_pairs_does_not_matter(seed, joint_kinds, precision):
    rng = np.random.default_rng(seed)
    q, x = noisy_pairs(rng, joint_kinds, 60)
    straight, shuffled = (KernelLearner(bases_for(joint_kinds), precision=precision) for _ in range(2))
    order = rng.permutation(60)
    straight.learn(q, x)
    for part in np.array_split(order, 7):
        shuffled.learn(q[part], x[part])
    test = random_q(rng, joint_kinds, 20, 80)
    np.testing.assert_allclose(straight.predict(test), shuffled.predict(test), rtol=0, atol=1e-6)


def test_memory_for_thirty_joints_scales_with_pairs():
    rng = np.random.default_rng(1)
    arm = rough_arm(rng, "R" * 30)
    n = 500
    q, x = arm.pairs(rng, n, 0.01)
    learner = KernelLearner(bases_for("R" * 30), arm.nominal)
    tracemalloc.start()
    learner.learn(q, x)
    learner.predict(q[:100])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 3.0 * 8 * n**2 + 8 * 3 * 30 * n * 8


def test_thirty_joint_learner_beats_its_prior():
    rng = np.random.default_rng(2)
    arm = rough_arm(rng, "R" * 30)
    q, x = arm.pairs(rng, 300, 0.01, reach_deg=10.0)
    learner = KernelLearner(bases_for("R" * 30), arm.nominal)
    learner.learn(q[:250], x[:250])

    def error(predicted: np.ndarray) -> float:
        return float(np.linalg.norm(predicted - arm.real.positions(q[250:]), axis=1).mean())

    assert error(learner.predict(q[250:])) < 0.7 * error(arm.nominal.positions(q[250:]))


def test_more_pairs_than_control_points_need_a_precision():
    rng = np.random.default_rng(3)
    learner = KernelLearner(bases_for("RR"), precision=None)
    learner.learn(*noisy_pairs(rng, "RR", 9))
    with pytest.raises(DegenerateDataError, match="9 control points"):
        learner.learn(*noisy_pairs(rng, "RR", 1))
    assert learner.pairs == 9


def test_repeated_noise_free_pairs_are_explained_exactly():
    rng = np.random.default_rng(4)
    q, x = random_q(rng, "RRR", 6, 80), rng.normal(size=(6, 3))
    learner = KernelLearner(bases_for("RRR"), precision=None)
    learner.learn(np.tile(q, (3, 1)), np.tile(x, (3, 1)))
    np.testing.assert_allclose(learner.predict(q), x, rtol=0, atol=1e-9)


def test_support_is_where_pairs_were():
    rng = np.random.default_rng(5)
    arm = rough_arm(rng, "RRRR")
    learner = KernelLearner(bases_for("RRRR"), arm.nominal)
    learner.learn(*arm.pairs(rng, 200, 0.002, reach_deg=15.0))
    near, far = random_q(rng, "RRRR", 100, 12), random_q(rng, "RRRR", 100, 180)
    assert learner.estimate(near).in_support.mean() > 0.95
    assert learner.estimate(far).in_support.mean() < 0.2


def test_untrained_learner_predicts_prior_with_infinite_sigma():
    rng = np.random.default_rng(6)
    chain = random_chain(rng, "RRR")
    learner = KernelLearner(bases_for("RRR"), chain)
    q = random_q(rng, "RRR", 5, 80)
    estimate = learner.estimate(q)
    np.testing.assert_array_equal(estimate.x, chain.positions(q))
    assert np.isinf(estimate.sigma).all()
    assert not estimate.in_support.any()


def test_another_prior_serves_the_same_pairs():
    rng = np.random.default_rng(7)
    first, second = random_chain(rng, "RRR"), random_chain(rng, "RRR")
    q, x = noisy_pairs(rng, "RRR", 15)
    moved, fresh = KernelLearner(bases_for("RRR"), first), KernelLearner(bases_for("RRR"), second)
    moved.learn(q, x)
    moved.predict(q)
    moved.rebase(second)
    fresh.learn(q, x)
    np.testing.assert_array_equal(moved.predict(q), fresh.predict(q))


@pytest.mark.parametrize("joint_kinds", ["RRRR", "RPRR"])
def test_its_control_points_are_those_of_its_predictions(joint_kinds):
    rng = np.random.default_rng(8)
    arm = rough_arm(rng, joint_kinds)
    learner = KernelLearner(bases_for(joint_kinds), arm.nominal)
    learner.learn(*arm.pairs(rng, 40, 0.01))
    q = random_q(rng, joint_kinds, 200, 180)
    np.testing.assert_allclose(learner.to_kbmap().predict(q), learner.predict(q), rtol=0, atol=1e-12)


@pytest.mark.parametrize("joint_kinds", ["RRRR", "RPRR"])
def test_its_derivative_is_that_of_its_control_points(joint_kinds):
    rng = np.random.default_rng(10)
    arm = rough_arm(rng, joint_kinds)
    learner = KernelLearner(bases_for(joint_kinds), arm.nominal)
    learner.learn(*arm.pairs(rng, 40, 0.01))
    q = random_q(rng, joint_kinds, 50, 180)
    expected = learner.to_kbmap().jacobian(q)
    np.testing.assert_allclose(learner.jacobian(q), expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(learner.jacobian(q[0]), expected[0], rtol=0, atol=1e-10)


@given(
    seed=seeds,
    prior=st.sampled_from(["none", "chain", "map"]),
    precision=st.sampled_from([0.1, "evidence", None]),
    told=st.booleans(),
)
def test_bytes_restore_predictions_bit_for_bit(seed, prior, precision, told):
    rng = np.random.default_rng(seed)
    behind = {"none": None, "chain": random_chain(rng, "RRP"), "map": random_map(rng, bases_for("RRP"))}[prior]
    learner = KernelLearner(bases_for("RRP"), behind, precision=precision, memory=Memory(12, 0.97))
    learner.learn(*noisy_pairs(rng, "RRP", 20), 0.01 if told else None)
    again = KernelLearner.from_bytes(learner.to_bytes())
    test = random_q(rng, "RRP", 20, 80)
    before, after = learner.estimate(test), again.estimate(test)
    np.testing.assert_array_equal(before.x, after.x)
    np.testing.assert_array_equal(before.sigma, after.sigma)
    assert again.pairs == learner.pairs == 20
    assert again.to_bytes() == learner.to_bytes()


def test_prior_not_stored_in_bytes_must_be_given():
    rng = np.random.default_rng(9)
    behind, other = KernelLearner(bases_for("RR")), KernelLearner(bases_for("RR"))
    q, x = noisy_pairs(rng, "RR", 6)
    behind.learn(q, x)
    learner = KernelLearner(bases_for("RR"), behind)
    learner.learn(q, x + 0.1)
    data = learner.to_bytes()
    with pytest.raises(ModelFormatError, match="KernelLearner"):
        KernelLearner.from_bytes(data)
    with pytest.raises(ModelFormatError, match="otherwise"):
        KernelLearner.from_bytes(data, other)
    np.testing.assert_array_equal(KernelLearner.from_bytes(data, behind).predict(q), learner.predict(q))


def test_prior_off_by_a_micrometre_is_refused():
    class Placed:
        joints = 2

        def __init__(self, x):
            self.x = x

        def predict(self, q):
            return np.broadcast_to([self.x, 0.0, 0.0], (*np.shape(q)[:-1], 3))

    learner = KernelLearner(bases_for("RR"), Placed(1.0))
    learner.learn(*noisy_pairs(np.random.default_rng(10), "RR", 6))
    with pytest.raises(ModelFormatError, match="otherwise"):
        KernelLearner.from_bytes(learner.to_bytes(), Placed(1.000001))


@given(where=st.integers(0, 2000), bit=st.integers(0, 7))
def test_damaged_bytes_are_refused(where, bit):
    learner = KernelLearner(bases_for("RR"))
    learner.learn(*noisy_pairs(np.random.default_rng(1), "RR", 5))
    data = bytearray(learner.to_bytes())
    data[where % len(data)] ^= 1 << bit
    with pytest.raises(ModelFormatError):
        KernelLearner.from_bytes(bytes(data))


def test_refused_pairs_change_nothing():
    learner: Model = KernelLearner(bases_for("RR"))
    learner.learn([[0.1, 0.2]], [[1.0, 2.0, 3.0]])
    before = learner.to_bytes()
    for error, q, x, sigma in (
        (ShapeError, np.zeros(3), np.zeros(3), None),
        (ShapeError, np.zeros((2, 2)), np.zeros((1, 3)), None),
        (NonFiniteError, [math.nan, 0.0], np.zeros(3), None),
        (SettingError, np.zeros(2), np.zeros(3), 0.0),
    ):
        with pytest.raises(error):
            learner.learn(q, x, sigma)
    assert learner.to_bytes() == before


@pytest.mark.parametrize("precision", [0.0, -1.0, math.inf, math.nan, "most"])
def test_an_impossible_precision_is_refused(precision):
    with pytest.raises(SettingError, match="precision"):
        KernelLearner(bases_for("R"), precision=precision)


@pytest.mark.soak
def test_claims_hold_on_average_over_arms():
    inside: list[np.ndarray] = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng, "RRRRRR")
        learner = KernelLearner(bases_for("RRRRRR"), arm.nominal)
        learner.learn(*arm.pairs(rng, 300, 0.01))
        q = random_q(rng, "RRRRRR", 200, 80)
        estimate = learner.estimate(q)
        off = np.abs(estimate.x - arm.real.positions(q)) / estimate.sigma
        inside.append(np.array([(off < 1.0).mean(), (off < 1.96).mean()]))
    one, two = np.mean(inside, axis=0)
    assert 0.6 < one < 0.85
    assert 0.9 < two < 1.0
