"""The fitted chain with residual: a value that predicts like the learner, and from which another learner can start."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import random_q
from rough_arms import ROUGH, Arm, rough_arm

from kbmaps import (
    ChainBelief,
    ChainParameters,
    InverseKinematics,
    ModelFormatError,
    ResidualLearner,
    ResidualModel,
    SettingError,
    ShapeError,
)
from kbmaps.residual.fit import innovations, most_probable

SIGMA = 0.003
DOWN = np.array([0.2, -0.3, -0.9])


def sagging(arm: Arm, q: np.ndarray, tool: np.ndarray | None = None) -> np.ndarray:
    """Return an arm with springs as joints under a weight at the marker's first place; a tool moves only the marker."""
    yielded = q.copy()
    for _ in range(30):
        yielded += 0.3 * (q + 0.15 * np.einsum("nij,i->nj", arm.real.jacobian(yielded), DOWN) - yielded)
    return (arm.real if tool is None else arm.real.with_tool(tool)).positions(yielded)


def taught(arm: Arm, q: np.ndarray, x: np.ndarray) -> ResidualLearner:
    learner = ResidualLearner(arm.nominal, ROUGH)
    learner.learn(q, x)
    return learner


def error(model: ResidualModel, q: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(model.predict(q) - truth, axis=1).mean())


@pytest.fixture(scope="module")
def arm() -> Arm:
    return rough_arm(np.random.default_rng(3))


@pytest.fixture(scope="module")
def learner(arm: Arm) -> ResidualLearner:
    rng = np.random.default_rng(4)
    q = random_q(rng, arm.kinds, 300, 80.0)
    return taught(arm, q, sagging(arm, q) + SIGMA * rng.normal(size=(300, 3)))


@pytest.fixture(scope="module")
def model(learner: ResidualLearner) -> ResidualModel:
    return learner.model


def test_model_predicts_like_its_learner_bit_for_bit(learner, model):
    q = random_q(np.random.default_rng(5), "RRRRRR", 50, 80.0)
    assert model.weights
    assert np.array_equal(model.predict(q), learner.predict(q))


def test_later_learning_does_not_touch_it(arm):
    rng = np.random.default_rng(6)
    q, x = arm.pairs(rng, 60, SIGMA)
    learner = taught(arm, q[:30], x[:30])
    model = learner.model
    before = model.predict(q)
    learner.learn(q[30:], x[30:])
    assert np.array_equal(model.predict(q), before)


def test_model_without_deviations_equals_rigid_chain(arm):
    q, x = arm.pairs(np.random.default_rng(7), 40)
    learner = taught(arm, q, x)
    assert not learner.model.weights
    np.testing.assert_allclose(learner.model.predict(q), learner.rigid.predict(q), rtol=0.0, atol=1e-12)


def test_without_pairs_it_is_the_nominal_chain(arm):
    q, _ = arm.pairs(np.random.default_rng(8), 20)
    model = ResidualLearner(arm.nominal, ROUGH).model
    np.testing.assert_allclose(model.predict(q), arm.nominal.positions(q), rtol=0.0, atol=1e-12)


def test_its_jacobian_is_that_of_its_predictions(model):
    q = random_q(np.random.default_rng(9), "RRRRRR", 10, 80.0)
    # Richardson's extrapolation of differences over other steps than the model's own.
    tables = []
    for step in (0.04, 0.02, 0.01):
        moves = step * np.eye(6)
        ends = [(model.predict(q + m) - model.predict(q - m)) / (2.0 * step) for m in moves]
        tables.append(np.stack(ends, axis=2))
    once = [(4.0 * b - a) / 3.0 for a, b in itertools.pairwise(tables)]
    exact = (16.0 * once[1] - once[0]) / 15.0
    np.testing.assert_allclose(model.jacobian(q), exact, rtol=0.0, atol=1e-8 * np.abs(exact).max())


def test_without_deviations_the_jacobian_is_the_chain_s(arm):
    q, _ = arm.pairs(np.random.default_rng(10), 5)
    model = ResidualLearner(arm.nominal, ROUGH).model
    assert np.array_equal(model.jacobian(q), model.chain.jacobian(q))


def test_single_jacobian_equals_its_row_of_a_batch(model):
    q = random_q(np.random.default_rng(11), "RRRRRR", 5, 80.0)
    np.testing.assert_allclose(model.jacobian(q[0]), model.jacobian(q)[0], rtol=0.0, atol=1e-11)


def test_bytes_restore_predictions_and_variances_bit_for_bit(model):
    again = ResidualModel.from_bytes(model.with_other_tool(0.2).to_bytes())
    q = random_q(np.random.default_rng(12), "RRRRRR", 20, 80.0)
    for one, other in zip(
        model.with_other_tool(0.2).predict_with_variance(q), again.predict_with_variance(q), strict=True
    ):
        assert np.array_equal(one, other)


def test_bytes_hold_no_pairs(arm):
    rng = np.random.default_rng(13)
    lengths = set()
    for pairs in (60, 300):
        q, x = arm.pairs(rng, pairs)
        lengths.add(len(taught(arm, q, x).model.to_bytes()) // 100)
    assert len(lengths) == 1


@pytest.mark.parametrize("place", [0, 20, 2000, -20, -1])
def test_damaged_bytes_are_refused(model, place):
    data = bytearray(model.to_bytes())
    data[place] ^= 0x10
    with pytest.raises(ModelFormatError):
        ResidualModel.from_bytes(bytes(data))


def test_bytes_of_another_kind_are_refused(learner):
    with pytest.raises(ModelFormatError):
        ResidualModel.from_bytes(learner.to_bytes())


def test_digest_distinguishes_models(learner, model):
    assert ResidualModel.from_bytes(model.to_bytes()).digest == model.digest
    assert len(model.digest) == 16
    weights = {group: values * 1.000001 for group, values in model.weights.items()}
    other = ResidualModel(model.features, model.change, weights, model.root, model.noise)
    assert other.digest != model.digest


def test_a_root_of_another_size_is_refused(model):
    with pytest.raises(ShapeError):
        ResidualModel(model.features, model.change, model.weights, model.root[:-1])


def test_another_tool_needs_a_tolerance(model):
    with pytest.raises(SettingError):
        model.with_other_tool(0.0)


def test_inverse_kinematics_reaches_positions_predicted_by_model(model):
    reach = np.full(6, np.radians(80.0))
    q = random_q(np.random.default_rng(14), "RRRRRR", 1, 50.0)[0]
    found = InverseKinematics(model, -reach, reach).solve(model.predict(q))
    assert found.converged
    assert np.linalg.norm(model.predict(found.q) - model.predict(q)) < 1e-4


@pytest.mark.parametrize("pairs", [10, 30, 100])
def test_with_another_tool_a_sagging_arm_stays_known(arm, model, pairs):
    rng = np.random.default_rng(15)
    tool = np.array([0.15, -0.2, 0.0])
    q = random_q(rng, arm.kinds, pairs, 80.0)
    x = sagging(arm, q, tool) + SIGMA * rng.normal(size=(pairs, 3))
    learners = [
        ResidualLearner(arm.nominal, ROUGH, prior)
        for prior in (model.with_other_tool(0.25), model.belief.with_other_tool(0.25))
    ]
    test = random_q(rng, arm.kinds, 300, 80.0)
    errors = []
    for learner in learners:
        learner.learn(q, x)
        errors.append(error(learner.model, test, sagging(arm, test, tool)))
    assert errors[0] < SIGMA
    assert errors[0] < 0.7 * float(
        np.linalg.norm(learners[1].rigid.predict(test) - sagging(arm, test, tool), axis=1).mean()
    )


def test_restored_learner_keeps_its_prior(arm, model):
    rng = np.random.default_rng(16)
    q = random_q(rng, arm.kinds, 20, 80.0)
    for prior in (model, model.belief):
        learner = ResidualLearner(arm.nominal, ROUGH, prior)
        learner.learn(q, sagging(arm, q))
        assert np.array_equal(ResidualLearner.from_bytes(learner.to_bytes()).predict(q), learner.predict(q))


def test_a_prior_of_another_chain_is_refused(model):
    other = rough_arm(np.random.default_rng(17), "RRR")
    with pytest.raises(ShapeError):
        ResidualLearner(other.nominal, ROUGH, model)


def test_a_belief_alone_is_a_rigid_model(arm):
    belief = ChainBelief.from_tolerances(ChainParameters(arm.nominal), ROUGH)
    q, _ = arm.pairs(np.random.default_rng(18), 10)
    x, variance = ResidualModel.of_belief(belief).predict_with_variance(q)
    expected, spread = belief.predict_with_variance(q)
    np.testing.assert_allclose(x, expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(variance, spread, rtol=1e-9, atol=0.0)


@given(seed=st.integers(0, 1000), correlation=st.floats(0.0, 0.97))
def test_innovations_of_an_autoregression_are_its_fresh_part(seed, correlation):
    fresh = np.random.default_rng(seed).normal(size=(30, 3))
    series = fresh.copy()
    for k in range(1, 30):
        series[k] = correlation * series[k - 1] + np.sqrt(1.0 - correlation**2) * fresh[k]
    np.testing.assert_allclose(innovations(series, correlation), fresh, atol=1e-9)


def test_the_most_probable_correlation_is_found_uphill():
    assert most_probable(lambda tried: -1000.0 * (tried - 0.8) ** 2, 0.0) == 0.8


def test_correlation_with_negligible_gain_is_set_to_zero():
    assert most_probable(lambda tried: tried, 0.0) == 0.0


def test_correlated_noise_on_path_keeps_sigma_honest(arm):
    rng = np.random.default_rng(19)
    steps = np.cumsum(rng.normal(0.0, np.radians(1.5), (500, 6)), axis=0)
    q = steps - steps.mean(axis=0)
    noise = rng.normal(size=(500, 3))
    for k in range(1, 500):
        noise[k] = 0.9 * noise[k - 1] + np.sqrt(1.0 - 0.81) * noise[k]
    learner = taught(arm, q, arm.real.positions(q) + SIGMA * noise)
    estimate = learner.estimate(q)
    inside = np.abs(estimate.x - arm.real.positions(q)) < 2.0 * estimate.sigma
    assert inside.mean() > 0.8


def test_an_empty_batch_is_no_trouble(model):
    none = np.empty((0, 6))
    assert model.predict(none).shape == (0, 3)
    assert model.jacobian(none).shape == (0, 3, 6)
