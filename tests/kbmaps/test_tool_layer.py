from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, random_chain, random_map, random_q
from rough_arms import ROUGH, rough_arm

from kbmaps import (
    KBMap,
    KernelLearner,
    Model,
    ModelFormatError,
    NonFiniteError,
    RigidChain,
    RigidLearner,
    SettingError,
    ShapeError,
    ToolLayer,
)

seeds = st.integers(0, 2**32 - 1)
kinds = st.text("RP", min_size=2, max_size=5)
SHIFT = np.array([0.1, -0.2, 0.12])


def seen(
    chain: RigidChain, rng: np.random.Generator, joint_kinds: str, n: int, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of the chain with a tool of `SHIFT`."""
    q = random_q(rng, joint_kinds, n, 80)
    return q, chain.with_tool(SHIFT).positions(q) + sigma * rng.normal(size=(n, 3))


@given(seed=seeds, joint_kinds=kinds, pairs=st.integers(1, 60), spread=st.floats(0.01, 10.0))
def test_it_is_batch_least_squares_with_a_prior(seed, joint_kinds, pairs, spread):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joint_kinds)
    q, x = seen(chain, rng, joint_kinds, pairs, 0.01)
    sigma = rng.uniform(0.005, 0.02, pairs)
    layer = ToolLayer(chain, spread=spread, outlier_sigmas=math.inf)
    for k in range(pairs):
        layer.learn(q[k], x[k], sigma[k])
    weights = np.repeat(1.0 / sigma, 3)[:, None]
    design = np.concatenate([chain.poses(q)[:, :3, :3].reshape(-1, 3) * weights, np.eye(3) / spread])
    target = np.concatenate([(x - chain.positions(q)).ravel() * weights[:, 0], np.zeros(3)])
    expected = np.linalg.lstsq(design, target)[0]
    np.testing.assert_allclose(layer.shift, expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(layer.covariance, np.linalg.inv(design.T @ design), rtol=1e-8, atol=1e-14)


@given(seed=seeds, joint_kinds=kinds, pairs=st.integers(1, 60), outliers=st.booleans(), told=st.booleans())
def test_the_order_of_the_pairs_does_not_matter(seed, joint_kinds, pairs, outliers, told):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joint_kinds)
    q, x = seen(chain, rng, joint_kinds, pairs, 0.01)
    if outliers:
        x[: pairs // 5] += 0.4
    order, sigma = rng.permutation(pairs), 0.01 if told else None
    straight, shuffled = ToolLayer(chain), ToolLayer(chain)
    straight.learn(q, x, sigma)
    for k in order:
        shuffled.learn(q[k], x[k], sigma)
    np.testing.assert_allclose(straight.shift, shuffled.shift, rtol=0, atol=1e-6)
    assert straight.noise == pytest.approx(shuffled.noise, rel=1e-4)


def test_pairs_that_live_on_in_sums_count_as_before():
    rng = np.random.default_rng(1)
    chain = random_chain(rng, "RRRR")
    q, x = seen(chain, rng, "RRRR", 3000, 0.01)
    layer = ToolLayer(chain, spread=math.inf)
    for part in np.array_split(np.arange(3000), 40):
        layer.learn(q[part], x[part])
    rotations = chain.poses(q)[:, :3, :3]
    mean = np.einsum("nji,nj->i", rotations, x - chain.positions(q)) / 3000
    np.testing.assert_allclose(layer.shift, mean, rtol=0, atol=1e-9)
    assert layer.noise == pytest.approx(0.01, rel=0.05)
    assert len(layer.inliers) < 256


@pytest.mark.parametrize("joint_kinds", ["RRRR", "RPRRR"])
def test_one_noise_free_pair_gives_an_exactly_known_arm_its_tool(joint_kinds):
    rng = np.random.default_rng(2)
    chain = random_chain(rng, joint_kinds)
    layer = ToolLayer(chain)
    layer.learn(*seen(chain, rng, joint_kinds, 1, 0.0))
    assert np.linalg.norm(layer.shift - SHIFT) < 1e-4
    layer.learn(*seen(chain, rng, joint_kinds, 2, 0.0))
    assert np.linalg.norm(layer.shift - SHIFT) < 1e-5


@pytest.mark.parametrize("pairs", [3, 30, 300])
def test_the_error_falls_with_the_root_of_the_pairs(pairs):
    errors = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        chain = random_chain(rng, "RRRRR")
        layer = ToolLayer(chain)
        layer.learn(*seen(chain, rng, "RRRRR", pairs, 0.02))
        errors.append(np.linalg.norm(layer.shift - SHIFT))
    # The mean norm of three Gaussians is 1.596 sigma.
    assert np.mean(errors) == pytest.approx(1.596 * 0.02 / math.sqrt(pairs), rel=0.3)


def test_a_sixth_of_gross_outliers_costs_next_to_nothing():
    clean, with_outliers = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        chain = random_chain(rng, "RRRRR")
        q, x = seen(chain, rng, "RRRRR", 60, 0.005)
        wrong = x.copy()
        directions = rng.normal(size=(10, 3))
        wrong[:10] += 0.2 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        good, spoilt = ToolLayer(chain), ToolLayer(chain)
        good.learn(q[10:], x[10:])
        spoilt.learn(q, wrong)
        clean.append(np.linalg.norm(good.shift - SHIFT))
        with_outliers.append(np.linalg.norm(spoilt.shift - SHIFT))
        assert not spoilt.inliers[:10].any()
    assert np.mean(with_outliers) <= 1.05 * np.mean(clean)


def test_an_outlier_that_comes_first_is_thrown_out_later():
    rng = np.random.default_rng(3)
    chain = random_chain(rng, "RRRR")
    q, x = seen(chain, rng, "RRRR", 20, 0.002)
    x[0] += 0.3
    layer = ToolLayer(chain)
    for k in range(20):
        layer.learn(q[k], x[k])
    assert np.linalg.norm(layer.shift - SHIFT) < 0.002
    assert not layer.inliers[0]


def test_a_told_tool_change_is_learnt_within_ten_pairs():
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        chain = random_chain(rng, "RRRRR")
        layer = ToolLayer(chain)
        q = random_q(rng, "RRRRR", 500, 80)
        layer.learn(q, chain.positions(q) + 0.005 * rng.normal(size=(500, 3)))
        layer.tool_changed(0.2)
        layer.learn(*seen(chain, rng, "RRRRR", 10, 0.005))
        errors.append(np.linalg.norm(layer.shift - SHIFT))
    assert np.mean(errors) < 0.003


def test_the_noise_stays_known_over_a_tool_change():
    rng = np.random.default_rng(4)
    chain = random_chain(rng, "RRR")
    layer = ToolLayer(chain)
    layer.learn(*seen(chain, rng, "RRR", 400, 0.003))
    layer.tool_changed(0.2)
    assert layer.noise == pytest.approx(0.003, rel=0.1)
    layer.learn(*seen(chain, rng, "RRR", 2, 0.003))
    assert layer.noise == pytest.approx(0.003, rel=0.15)


@given(seed=seeds, joint_kinds=st.text("RP", min_size=1, max_size=4))
def test_the_baked_map_predicts_what_the_layer_predicts(seed, joint_kinds):
    rng = np.random.default_rng(seed)
    bases = bases_for(joint_kinds)
    # Any net: its planes need not be orthonormal for the baking to be exact.
    net = np.concatenate([random_map(rng, bases).net for _ in range(4)])
    layer = ToolLayer(KBMap(bases, net))
    q = random_q(rng, joint_kinds, 30, 80)
    layer.learn(q, rng.normal(size=(30, 3)))
    baked = layer.baked()
    assert isinstance(baked, KBMap)
    np.testing.assert_allclose(baked.predict(q), layer.predict(q), rtol=0, atol=1e-11)
    np.testing.assert_array_equal(baked.orientation(q), layer.orientation(q))


def test_a_baked_chain_is_the_chain_with_its_tool():
    rng = np.random.default_rng(5)
    chain = random_chain(rng, "RPR")
    layer = ToolLayer(chain)
    layer.learn(*seen(chain, rng, "RPR", 10, 0.01))
    baked = layer.baked()
    assert isinstance(baked, RigidChain)
    q = random_q(rng, "RPR", 20, 80)
    np.testing.assert_allclose(baked.positions(q), layer.predict(q), rtol=0, atol=1e-12)


@pytest.mark.soak
def test_the_claim_covers_the_error():
    inside = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        chain = random_chain(rng, "RRRR")
        layer = ToolLayer(chain)
        layer.learn(*seen(chain, rng, "RRRR", 15, 0.01))
        q = random_q(rng, "RRRR", 20, 80)
        estimate = layer.estimate(q)
        inside.append((np.abs(estimate.x - chain.with_tool(SHIFT).positions(q)) < estimate.sigma).mean())
        assert estimate.in_support.all()
    assert 0.62 < np.mean(inside) < 0.74


def test_what_the_arm_itself_is_unsure_of_is_claimed_too():
    rng = np.random.default_rng(6)
    arm = rough_arm(rng, "RRRR")
    batch = RigidLearner(arm.nominal, ROUGH)
    batch.learn(*arm.pairs(rng, 100, 0.005, reach_deg=15.0))

    class Oriented:
        """The learner's predictions with its chain's orientations."""

        joints = 4
        predict, jacobian, estimate = batch.predict, batch.jacobian, batch.estimate
        orientation, angular_jacobian = batch.chain.orientation, batch.chain.angular_jacobian

    layer = ToolLayer(Oriented())
    q = random_q(rng, "RRRR", 200, 15)
    layer.learn(q, arm.real.with_tool(SHIFT).positions(q), 0.001)
    far = random_q(rng, "RRRR", 50, 150)
    claim, behind = layer.estimate(far), batch.estimate(far)
    assert (claim.sigma > behind.sigma).all()
    assert not claim.in_support[~behind.in_support].any()
    np.testing.assert_allclose(layer.jacobian(q), batch.chain.with_tool(layer.shift).jacobian(q), rtol=0, atol=1e-12)


def test_without_pairs_the_arm_is_predicted_and_nothing_supported():
    rng = np.random.default_rng(7)
    chain = random_chain(rng, "RR")
    q = random_q(rng, "RR", 5, 80)
    estimate = ToolLayer(chain, spread=0.5).estimate(q)
    np.testing.assert_array_equal(estimate.x, chain.positions(q))
    np.testing.assert_allclose(estimate.sigma, 0.5, rtol=1e-9)
    assert not estimate.in_support.any()


@given(seed=seeds, pairs=st.sampled_from([0, 7, 300]), told=st.booleans(), of_map=st.booleans())
def test_its_bytes_predict_the_same_to_the_last_bit(seed, pairs, told, of_map):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, "RPR")
    model = chain.to_kbmap(bases_for("RPR"), orientation=True) if of_map else chain
    layer: Model = ToolLayer(model)
    layer.learn(*seen(chain, rng, "RPR", pairs, 0.01), 0.01 if told else None)
    again = ToolLayer.from_bytes(layer.to_bytes())
    q = random_q(rng, "RPR", 10, 80)
    before, after = layer.estimate(q), again.estimate(q)
    np.testing.assert_array_equal(before.x, after.x)
    np.testing.assert_array_equal(before.sigma, after.sigma)
    assert again.pairs == pairs
    assert again.to_bytes() == layer.to_bytes()


def test_a_model_that_does_not_travel_is_asked_for():
    rng = np.random.default_rng(8)
    chain = random_chain(rng, "RR")
    inner = ToolLayer(chain)
    layer = ToolLayer(inner)
    layer.learn(*seen(chain, rng, "RR", 4, 0.01))
    with pytest.raises(ModelFormatError, match="ToolLayer"):
        ToolLayer.from_bytes(layer.to_bytes())
    q = random_q(rng, "RR", 4, 80)
    np.testing.assert_array_equal(ToolLayer.from_bytes(layer.to_bytes(), inner).predict(q), layer.predict(q))
    with pytest.raises(SettingError, match="cannot take in a tool"):
        layer.baked()


def test_bytes_of_something_else_are_refused():
    with pytest.raises(ModelFormatError):
        ToolLayer.from_bytes(KernelLearner(bases_for("RR")).to_bytes())


def test_misuse_is_refused_and_changes_nothing():
    rng = np.random.default_rng(9)
    chain = random_chain(rng, "RR")
    with pytest.raises(ShapeError):
        ToolLayer(random_map(rng, bases_for("RR")))
    for wrong in ({"spread": 0.0}, {"spread": math.nan}, {"noise": 0.0}, {"noise": math.inf}, {"outlier_sigmas": 0.0}):
        with pytest.raises(SettingError):
            ToolLayer(chain, **wrong)
    layer = ToolLayer(chain)
    before = layer.to_bytes()
    with pytest.raises(NonFiniteError):
        layer.learn([0.0, math.nan], np.zeros(3))
    with pytest.raises(SettingError):
        layer.learn(np.zeros(2), np.zeros(3), -1.0)
    with pytest.raises(SettingError, match="tolerance"):
        layer.tool_changed(0.0)
    assert layer.to_bytes() == before
