from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planted_chains import random_q
from rough_arms import ROUGH, rough_arm

from kbmaps import (
    ChainTolerances,
    ModelFormatError,
    NonFiniteError,
    RecursiveRigidLearner,
    RigidLearner,
    SettingError,
    ShapeError,
)

# Tests that depend on the kernels; test_kernels.py shows that both agree on everything else.
on_both_paths = pytest.mark.usefixtures("kernel_path")

seeds = st.integers(0, 2**32 - 1)
# Everything may be off, so that a third of the directions show in no position, and some others hardly.
CRUDE = ChainTolerances(axes=0.05, points=0.015, zeros=0.05, tool=0.06, base_rotation=0.05, base_translation=0.015)
SLIGHT = ChainTolerances(axes=1e-4, points=1e-4, zeros=1e-4, slide_zeros=1e-4, tool=1e-4, base_rotation=1e-4)


@given(seed=seeds, kinds=st.sampled_from(["RRRR", "RPR", "RRRRRRR"]))
@settings(max_examples=8)
def test_recursive_equals_batch_for_linear_problem(seed, kinds):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng, kinds, SLIGHT)
    q, x = arm.pairs(rng, 30, 2e-5)
    batch, recursive = RigidLearner(arm.nominal, SLIGHT), RecursiveRigidLearner(arm.nominal, SLIGHT)
    batch.learn(q, x, 1e-4)
    recursive.learn(q, x, 1e-4)
    test = random_q(rng, kinds, 50, 80)
    one, other = batch.estimate(test), recursive.estimate(test)
    np.testing.assert_allclose(other.x, one.x, rtol=0, atol=2e-7)
    np.testing.assert_allclose(other.sigma, one.sigma, rtol=5e-3)


def test_thirty_exact_pairs_correct_rough_nominal_model():
    errors = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng)
        learner = RecursiveRigidLearner(arm.nominal, ROUGH)
        learner.learn(*arm.pairs(rng, 30), 1e-4)
        errors.append(arm.error(learner, rng))
    assert max(errors) < 1e-5


def test_one_sigma_coverage_holds_at_every_stage():
    inside: dict[int, list[float]] = {3: [], 30: [], 100: []}
    for seed in range(8):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng, "RRRRR")
        learner = RecursiveRigidLearner(arm.nominal, ROUGH)
        test = random_q(rng, arm.kinds, 50, 80)
        for stage, shares in inside.items():
            learner.learn(*arm.pairs(rng, stage - learner.pairs, 0.01), 0.01)
            estimate = learner.estimate(test)
            shares.append((np.abs(estimate.x - arm.real.positions(test)) < estimate.sigma).mean())
    # 8 arms with some 27 directions each: 3 % is the standard error of a mean.
    assert all(0.60 < np.mean(shares) < 0.77 for shares in inside.values())


@pytest.mark.parametrize("sigma", [0.003, 0.02])
def test_noise_is_estimated_when_not_given(sigma):
    rng = np.random.default_rng(3)
    arm = rough_arm(rng)
    learner = RecursiveRigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 200, sigma))
    assert learner.noise == pytest.approx(sigma, rel=0.1)


@on_both_paths
def test_new_tool_is_learnt_from_ten_noisy_pairs():
    rng = np.random.default_rng(4)
    arm = rough_arm(rng, "RRRRRRR")
    learner = RecursiveRigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 100, 0.005), 0.005)
    moved = arm.real.with_tool([0.1, -0.1, 0.15])
    q = random_q(rng, arm.kinds, 10, 80)
    learner.tool_changed(0.2)
    learner.learn(q, moved.positions(q) + 0.005 * rng.normal(size=(10, 3)), 0.005)
    test = random_q(rng, arm.kinds, 200, 80)
    assert np.linalg.norm(learner.predict(test) - moved.positions(test), axis=1).mean() < 0.005


def test_tool_change_frees_a_fixed_tool():
    rng = np.random.default_rng(6)
    tolerances = replace(ROUGH, tool=0.0)
    arm = rough_arm(rng, "RRRR", tolerances)
    learner = RecursiveRigidLearner(arm.nominal, tolerances)
    learner.learn(*arm.pairs(rng, 100, 0.001), 0.001)
    moved = arm.real.with_tool([0.1, 0.0, 0.1])
    learner.tool_changed(0.2)
    q = random_q(rng, arm.kinds, 20, 80)
    learner.learn(q, moved.positions(q), 0.001)
    np.testing.assert_allclose(learner.predict(q), moved.positions(q), atol=0.003)


@on_both_paths
def test_ten_percent_gross_outliers_are_tolerated():
    rng = np.random.default_rng(7)
    arm = rough_arm(rng)
    q, x = arm.pairs(rng, 100, 0.005)
    x[::10] += rng.choice([-1, 1], (10, 3)) * rng.uniform(0.2, 0.4, (10, 3))
    learner = RecursiveRigidLearner(arm.nominal, ROUGH)
    learner.learn(q, x, 0.005)
    assert arm.error(learner, rng) < 0.006


@pytest.mark.parametrize(("told", "pairs"), [(True, 30), (False, 100)])
@pytest.mark.soak
def test_early_outliers_cost_under_ten_percent_accuracy(told, pairs):
    spoilt, clean = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng)
        q, x = arm.pairs(rng, pairs, 0.01)
        wrong = rng.permutation(pairs)[: round(0.15 * pairs)]
        directions = rng.normal(size=(len(wrong), 3))
        x[wrong] += 0.2 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        good = np.setdiff1d(np.arange(pairs), wrong)
        learner, batch = RecursiveRigidLearner(arm.nominal, ROUGH), RigidLearner(arm.nominal, ROUGH)
        learner.learn(q, x, 0.01 if told else None)
        batch.learn(q[good], x[good], 0.01 if told else None)
        spoilt.append(arm.error(learner, rng))
        clean.append(arm.error(batch, rng))
    assert np.mean(spoilt) < 1.1 * np.mean(clean)


@pytest.mark.parametrize(
    "noise", [1e-6, 1e-2, *(pytest.param(noise, marks=pytest.mark.soak) for noise in (1e-5, 1e-4))]
)
def test_initial_noise_is_irrelevant_after_thirty_pairs(noise):
    rng = np.random.default_rng(11)
    arm = rough_arm(rng)
    learner = RecursiveRigidLearner(arm.nominal, ROUGH, noise=noise)
    learner.learn(*arm.pairs(rng, 30, 1e-4))
    assert learner.noise == pytest.approx(1e-4, rel=0.4)
    assert arm.error(learner, rng) < 2e-4


def test_path_from_crude_nominal_model_matches_batch():
    rng = np.random.default_rng(12)
    crude = ChainTolerances(axes=0.15, points=0.05, tool=0.1)
    arm = rough_arm(rng, "RRRRRRR", crude)
    # One joint after the other: the early pairs carry no information on the later joints.
    q = np.concatenate([np.cumsum(0.04 * rng.normal(size=(45, 7)) * (np.arange(7) == k), axis=0) for k in range(7)])
    x = arm.real.positions(q) + 7e-4 * rng.normal(size=(len(q), 3))
    batch = RigidLearner(arm.nominal, crude)
    learner = RecursiveRigidLearner(arm.nominal, crude, window=110)
    batch.learn(q, x)
    learner.learn(q, x)
    one, other = batch.estimate(q), learner.estimate(q)
    assert np.abs(other.x - one.x).max() < 1.5 * one.sigma.max()


def most_apart_from_a_batch(seed: int) -> float:
    """Return the largest RMS difference from a batch fit between refits, in the batch's sigma."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng, "RRRRR", CRUDE)
    q, x = arm.pairs(rng, 190, 5e-4, 60.0)
    test = random_q(rng, arm.kinds, 100, 60)
    learner, batch, apart = RecursiveRigidLearner(arm.nominal, CRUDE), RigidLearner(arm.nominal, CRUDE), []
    for begin, end in itertools.pairwise([0, 140, *range(150, 191, 10)]):
        learner.learn(q[begin:end], x[begin:end])
        batch.learn(q[begin:end], x[begin:end])
        expected = batch.estimate(test)
        apart.append(np.sqrt(np.square((learner.predict(test) - expected.x) / expected.sigma).mean()))
    return max(apart)


def test_between_refits_it_stays_where_a_batch_is():
    assert most_apart_from_a_batch(0) < 0.3


@pytest.mark.soak
def test_many_arms_stay_near_the_batch_between_refits():
    apart = [most_apart_from_a_batch(seed) for seed in range(100)]
    assert np.quantile(apart, 0.95) < 0.3
    assert max(apart) < 1.0


def test_claims_between_refits_are_those_of_a_batch():
    rng = np.random.default_rng(18)
    arm = rough_arm(rng, "RRRRR", CRUDE)
    q, x = arm.pairs(rng, 205, 5e-4, 60.0)
    learner, batch = RecursiveRigidLearner(arm.nominal, CRUDE), RigidLearner(arm.nominal, CRUDE)
    learner.learn(q, x, 5e-4)
    batch.learn(q, x, 5e-4)
    test = random_q(rng, arm.kinds, 100, 60)
    np.testing.assert_allclose(learner.estimate(test).sigma, batch.estimate(test).sigma, rtol=0.1)


@on_both_paths
@pytest.mark.parametrize("sigma", [None, 0.004])
def test_vectors_and_rows_teach_bit_identically(sigma):
    rng = np.random.default_rng(19)
    arm = rough_arm(rng, "RPR")
    q, x = arm.pairs(rng, 30, 0.004)
    in_vectors, in_rows = (RecursiveRigidLearner(arm.nominal, ROUGH) for _ in range(2))
    for k in range(len(q)):
        in_vectors.learn(q[k], x[k], sigma)
    in_rows.learn(q, x, sigma)
    assert in_vectors.to_bytes() == in_rows.to_bytes()


@given(seed=seeds, cuts=st.lists(st.integers(1, 44), max_size=4))
@settings(max_examples=3)
def test_batch_boundaries_do_not_change_predictions(seed, cuts):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng, "RRR")
    q, x = arm.pairs(rng, 45, 0.005)
    at_once, in_portions = (RecursiveRigidLearner(arm.nominal, ROUGH, window=20) for _ in range(2))
    at_once.learn(q, x)
    for part in np.split(np.arange(45), sorted(cuts)):
        in_portions.learn(q[part], x[part])
    test = random_q(rng, "RRR", 20, 80)
    np.testing.assert_allclose(in_portions.predict(test), at_once.predict(test), rtol=0, atol=1e-9)


@on_both_paths
def test_its_memory_is_bounded_by_the_window():
    rng = np.random.default_rng(13)
    arm = rough_arm(rng, "RRR")
    learner = RecursiveRigidLearner(arm.nominal, ROUGH, window=40)
    sizes = []
    for _ in range(10):
        learner.learn(*arm.pairs(rng, 25, 0.005))
        assert learner.kept < 40
        sizes.append(len(learner.to_bytes()))
    assert learner.pairs == 250
    assert max(sizes) < 40 * 8 * 7 + 8000


def test_folded_pairs_count_as_much_as_kept_ones():
    rng = np.random.default_rng(15)
    arm = rough_arm(rng)
    q, x = arm.pairs(rng, 120, 0.01)
    batch, learner = RigidLearner(arm.nominal, ROUGH), RecursiveRigidLearner(arm.nominal, ROUGH, window=60)
    batch.learn(q, x)
    learner.learn(q, x)
    test = random_q(rng, arm.kinds, 100, 80)
    one, other = batch.estimate(test), learner.estimate(test)
    assert np.abs(other.x - one.x).max() < 0.5 * one.sigma.min()
    np.testing.assert_allclose(other.sigma, one.sigma, rtol=0.1)


def test_arm_with_unknown_base_pose_is_learnt():
    rng = np.random.default_rng(16)
    planted = ChainTolerances(zeros=0.03, tool=0.1, base_rotation=0.9, base_translation=1.0)
    arm = rough_arm(rng, "RRRRRR", planted)
    anywhere = ChainTolerances(zeros=0.03, tool=np.inf, base_rotation=np.inf, base_translation=np.inf)
    learner = RecursiveRigidLearner(arm.nominal, anywhere)
    learner.learn(*arm.pairs(rng, 60, 0.001))
    assert arm.error(learner, rng) < 0.001


def test_non_rigid_arm_widens_sigma_with_given_noise():
    rng = np.random.default_rng(17)
    arm = rough_arm(rng)
    q, x = arm.pairs(rng, 100)
    learner = RecursiveRigidLearner(arm.nominal, ROUGH)
    learner.learn(q, x + 0.01 * np.sin(3.0 * q[:, :3]) + 0.001 * rng.normal(size=x.shape), 0.001)
    rest = learner.predict(q) - (x + 0.01 * np.sin(3.0 * q[:, :3]))
    assert learner.estimate(q).sigma.mean() == pytest.approx(np.sqrt(np.square(rest).mean()), rel=0.2)


@on_both_paths
def test_a_wild_pair_leaves_finite_numbers():
    rng = np.random.default_rng(8)
    arm = rough_arm(rng)
    learner = RecursiveRigidLearner(arm.nominal, ROUGH)
    learner.learn(rng.normal(size=6), [1e9, -1e9, 1e9])
    learner.learn(*arm.pairs(rng, 25, 0.005))
    assert arm.error(learner, rng) < 0.02


@on_both_paths
@pytest.mark.parametrize("sigma", [0.004, None])
@pytest.mark.parametrize("tool_changed", [False, True])
def test_restored_learner_continues_bit_for_bit(tool_changed, sigma):
    rng = np.random.default_rng(9)
    arm = rough_arm(rng, "RPRR")
    learner = RecursiveRigidLearner(arm.nominal, ROUGH, noise=0.02)
    learner.learn(*arm.pairs(rng, 30, 0.004), sigma)
    if tool_changed:
        learner.tool_changed(0.1)
    twin = RecursiveRigidLearner.from_bytes(learner.to_bytes())
    more = arm.pairs(rng, 20, 0.004)
    learner.learn(*more, sigma)
    twin.learn(*more, sigma)
    assert twin.to_bytes() == learner.to_bytes()
    np.testing.assert_array_equal(twin.chain.fixed, learner.chain.fixed)


def test_bytes_of_the_other_learner_are_refused():
    arm = rough_arm(np.random.default_rng(1), "RR")
    with pytest.raises(ModelFormatError, match="something else"):
        RecursiveRigidLearner.from_bytes(RigidLearner(arm.nominal, ROUGH).to_bytes())


@on_both_paths
@pytest.mark.parametrize(
    ("q", "x", "sigma", "error"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), None, ShapeError),
        (np.array([[0.1] * 6, [np.nan] * 6]), np.zeros((2, 3)), None, NonFiniteError),
        (np.zeros((2, 6)), np.zeros((2, 3)), [0.1, -0.1], SettingError),
    ],
)
def test_batch_with_bad_rows_changes_nothing(q, x, sigma, error):
    learner = RecursiveRigidLearner(rough_arm(np.random.default_rng(14)).nominal, ROUGH)
    before = learner.to_bytes()
    with pytest.raises(error):
        learner.learn(q, x, sigma)
    assert learner.to_bytes() == before


@pytest.mark.parametrize("wrong", [0.0, -1.0, float("nan"), float("inf")])
def test_a_tool_change_of_no_size_is_refused(wrong):
    learner = RecursiveRigidLearner(rough_arm(np.random.default_rng(14)).nominal, ROUGH)
    with pytest.raises(SettingError):
        learner.tool_changed(wrong)
    with pytest.raises(SettingError):
        RecursiveRigidLearner(learner.nominal, ROUGH, noise=wrong)


def test_window_below_sixteen_pairs_is_refused():
    with pytest.raises(SettingError, match="16 pairs"):
        RecursiveRigidLearner(rough_arm(np.random.default_rng(14)).nominal, ROUGH, window=15)
