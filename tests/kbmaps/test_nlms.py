from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, literal_weights, random_chain, random_map, random_q

from kbmaps import (
    NLMS,
    JointBasis,
    ModelFormatError,
    NonFiniteError,
    SettingError,
    ShapeError,
    StepSize,
    prediction_errors,
)

pytestmark = pytest.mark.usefixtures("kernel_path")

seeds = st.integers(0, 2**32 - 1)


@given(seed=seeds, joints=st.integers(1, 4), mu0=st.floats(0.05, 1.95))
def test_a_step_is_that_of_equation_20(seed, joints, mu0):
    rng = np.random.default_rng(seed)
    alpha = 1.0
    kbmap = random_map(rng, [JointBasis.bernstein(alpha)] * joints)
    q, p = rng.uniform(-2.5, 2.5, joints), rng.normal(size=3)
    w = literal_weights(q, alpha)
    mu = mu0 / sum(w_i**2 for w_i in w)
    b = kbmap.net.reshape(3, -1).T
    f = sum(w_i * b_i for w_i, b_i in zip(w, b, strict=True))
    expected = np.array([b_i - mu * (f - p) * w_i for w_i, b_i in zip(w, b, strict=True)])
    learner = NLMS(kbmap, mu0)
    learner.learn(q, p)
    learnt = learner.map.net.reshape(3, -1).T
    np.testing.assert_allclose(learnt, expected, rtol=0, atol=1e-11 * max(1.0, np.abs(expected).max()))


@given(seed=seeds, mu0=st.floats(0.05, 1.95), kinds=st.text("RP", min_size=1, max_size=4))
def test_step_reduces_error_by_the_share_mu0(seed, mu0, kinds):
    rng = np.random.default_rng(seed)
    kbmap = random_map(rng, bases_for(kinds))
    q, x = random_q(rng, kinds, 1, 80)[0], rng.normal(size=3)
    learner = NLMS(kbmap, mu0)
    learner.learn(q, x)
    error = (1 - mu0) * (x - kbmap.predict(q))
    np.testing.assert_allclose(x - learner.map.predict(q), error, rtol=0, atol=1e-11)


@given(seed=seeds, kinds=st.text("RP", min_size=1, max_size=4), pairs=st.integers(0, 200))
def test_replay_equals_one_step_after_the_other(seed, kinds, pairs):
    rng = np.random.default_rng(seed)
    kbmap = random_map(rng, bases_for(kinds))
    q, x = random_q(rng, kinds, max(pairs, 1), 80), rng.normal(size=(max(pairs, 1), 3))
    order = rng.integers(0, len(q), pairs)
    blockwise, sequential = NLMS(kbmap, 0.7), NLMS(kbmap, 0.7)
    blockwise.replay(q, x, order)
    for i in order:
        sequential.learn(q[i], x[i])
    np.testing.assert_allclose(blockwise.map.net, sequential.map.net, rtol=0, atol=1e-11)


def test_replaying_noise_free_pairs_approaches_the_chain():
    rng = np.random.default_rng(2)
    kinds = "RRR"
    chain, nominal = random_chain(rng, kinds), random_chain(rng, kinds)
    q = random_q(rng, kinds, 200, 80)
    learner = NLMS(nominal.to_kbmap(bases_for(kinds)))
    for _ in range(50):
        learner.replay(q, chain.positions(q), rng.permutation(len(q)))
    test = random_q(rng, kinds, 200, 80)
    assert prediction_errors(learner.map, test, chain.positions(test)).mean() < 1e-4


def test_learner_and_its_map_predict_the_same():
    rng = np.random.default_rng(6)
    kbmap = random_map(rng, bases_for("RPR"))
    learner = NLMS(kbmap)
    q, x = rng.uniform(-0.5, 0.5, (20, 3)), rng.normal(size=(20, 3))
    learner.learn(q[0], x[0])
    learner.replay(q, x)
    np.testing.assert_array_equal(learner.predict(q), learner.map.predict(q))
    np.testing.assert_array_equal(learner.predict(q[0]), learner.map.predict(q[0]))


def test_a_snapshot_does_not_follow_later_learning():
    rng = np.random.default_rng(1)
    kbmap = random_map(rng, bases_for("RR"))
    learner = NLMS(kbmap)
    learner.learn([0.1, 0.2], [1.0, 2.0, 3.0])
    snapshot = learner.map
    digest = snapshot.digest
    learner.learn([0.3, 0.2], [1.0, 2.0, 3.0])
    assert snapshot.digest == digest != learner.map.digest


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_nan_is_refused_and_changes_nothing(bad):
    kbmap = random_map(np.random.default_rng(1), bases_for("RR"))
    learner = NLMS(kbmap)
    good_q, good_x = np.zeros((2, 2)), np.zeros((2, 3))
    bad_q, bad_x = good_q.copy(), good_x.copy()
    bad_q[1, 0] = bad_x[1, 2] = bad
    for q, x in ((bad_q, good_x), (good_q, bad_x)):
        with pytest.raises(NonFiniteError):
            learner.learn(q[1], x[1])
        with pytest.raises(NonFiniteError):
            learner.replay(q, x)
    assert learner.map.digest == kbmap.digest


def test_wrong_shapes_are_refused_and_change_nothing():
    kbmap = random_map(np.random.default_rng(1), bases_for("RR"))
    learner = NLMS(kbmap)
    with pytest.raises(ShapeError):
        learner.learn(np.zeros(3), np.zeros(3))
    with pytest.raises(ShapeError):
        learner.learn(np.zeros(2), np.zeros(2))
    with pytest.raises(ShapeError):
        learner.replay(np.zeros((4, 2)), np.zeros((3, 3)))
    with pytest.raises(SettingError, match=r"0\.\.3"):
        learner.replay(np.zeros((4, 2)), np.zeros((4, 3)), [0, 4])
    assert learner.map.digest == kbmap.digest


@pytest.mark.parametrize("mu0", [0.0, 2.0, -1.0, math.nan])
def test_an_unstable_rate_is_refused(mu0):
    with pytest.raises(SettingError, match="mu0"):
        NLMS(random_map(np.random.default_rng(1), bases_for("R")), mu0)


@given(seed=seeds, decay=st.floats(0.5, 100.0), floor=st.floats(0.0, 0.5), pairs=st.integers(1, 150))
def test_replay_follows_step_schedule_like_single_steps(seed, decay, floor, pairs):
    rng = np.random.default_rng(seed)
    kbmap = random_map(rng, bases_for("RRP"))
    q, x = random_q(rng, "RRP", pairs, 80), rng.normal(size=(pairs, 3))
    schedule = StepSize(1.0, decay, floor)
    blockwise, sequential = NLMS(kbmap, schedule), NLMS(kbmap, schedule)
    blockwise.replay(q, x)
    for k in range(pairs):
        sequential.learn(q[k], x[k])
    np.testing.assert_allclose(blockwise.map.net, sequential.map.net, rtol=0, atol=1e-10)
    assert blockwise.pairs == sequential.pairs == pairs


@given(mu0=st.floats(0.01, 1.99), decay=st.floats(0.1, 1e4), share=st.floats(0.0, 1.0), pairs=st.integers(0, 10_000))
def test_a_schedule_falls_from_mu0_to_its_floor(mu0, decay, share, pairs):
    schedule = StepSize(mu0, decay, share * mu0)
    assert schedule.at(0) == mu0
    assert schedule.at(pairs) >= schedule.at(pairs + 1) >= schedule.floor
    assert schedule.at(pairs) == max(share * mu0, mu0 / (1.0 + pairs / decay))
    np.testing.assert_array_equal(schedule.run(pairs, 3), [schedule.at(pairs + k) for k in range(3)])


def test_step_of_one_over_n_gives_the_mean():
    rng = np.random.default_rng(3)
    learner = NLMS(random_map(rng, bases_for("RR")), StepSize(1.0, 1.0))
    x = rng.normal(size=(40, 3))
    for position in x:
        learner.learn([0.3, -0.4], position)
    np.testing.assert_allclose(learner.map.predict([0.3, -0.4]), x.mean(axis=0), rtol=0, atol=1e-12)


def test_decaying_step_leaves_less_noise_than_constant_step():
    rng = np.random.default_rng(4)
    chain = random_chain(rng, "RRR")
    q = random_q(rng, "RRR", 4000, 80)
    x, test = chain.positions(q) + 0.02 * rng.normal(size=(4000, 3)), random_q(rng, "RRR", 300, 80)
    errors = []
    for step_size in (StepSize(0.5), StepSize(0.5, 100.0, 0.02)):
        learner = NLMS(chain.to_kbmap(bases_for("RRR")), step_size)
        learner.replay(q, x)
        errors.append(prediction_errors(learner.map, test, chain.positions(test)).mean())
    assert errors[1] < 0.4 * errors[0]


@given(seed=seeds, decay=st.sampled_from([math.inf, 10.0]))
def test_bytes_learn_on_to_the_last_bit(seed, decay):
    rng = np.random.default_rng(seed)
    learner = NLMS(random_map(rng, bases_for("RPR")), StepSize(0.8, decay, 0.1))
    q, x = random_q(rng, "RPR", 30, 80), rng.normal(size=(30, 3))
    learner.replay(q[:20], x[:20])
    again = NLMS.from_bytes(learner.to_bytes())
    for one in (learner, again):
        one.replay(q[20:], x[20:])
        one.learn(q[0], x[0])
    assert again.map.digest == learner.map.digest
    assert again.to_bytes() == learner.to_bytes()


def test_bytes_of_something_else_are_refused():
    kbmap = random_map(np.random.default_rng(1), bases_for("RR"))
    with pytest.raises(ModelFormatError):
        NLMS.from_bytes(kbmap.to_bytes())
    with pytest.raises(ModelFormatError):
        NLMS.from_bytes(NLMS(kbmap).to_bytes()[:-1])


@pytest.mark.parametrize("wrong", [{"decay": 0.0}, {"decay": math.nan}, {"floor": -0.1}, {"floor": 0.9}])
def test_an_impossible_schedule_is_refused(wrong):
    with pytest.raises(SettingError):
        StepSize(**wrong)
