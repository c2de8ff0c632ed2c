from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, random_chain, random_q

from kbmaps import (
    BasisError,
    CorePrior,
    DegenerateDataError,
    ModelFormatError,
    NonFiniteError,
    RigidChain,
    SettingError,
    ShapeError,
    TensorLearner,
    TensorSettings,
)
from kbmaps.model import Model

SIGMA_M = 0.01
AT_ONCE = TensorSettings(refit_every=1)


def perturbed(chain: RigidChain, rng: np.random.Generator) -> RigidChain:
    """Return the chain with every link turned by about 3 degrees and shifted by about 15 mm per component."""
    turns = [random_small_turn(rng, np.radians(3.0)) for _ in range(len(chain.fixed))]
    fixed = chain.fixed.copy()
    fixed[:, :3, :3] = fixed[:, :3, :3] @ np.array(turns)
    fixed[:, :3, 3] += 0.015 * rng.normal(size=(len(fixed), 3))
    return RigidChain(fixed, chain.axes, chain.prismatic)


def random_small_turn(rng: np.random.Generator, std: float) -> np.ndarray:
    x, y, z = std * rng.normal(size=3)
    orthogonal, upper = np.linalg.qr(np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    return orthogonal * np.sign(np.diag(upper))


def case(kinds: str, n: int, seed: int, sigma: float = 0.0, revolute_deg: float = 80.0):
    """Return a true chain, a rough prior of it, and n pairs."""
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, kinds)
    q = random_q(rng, kinds, n, revolute_deg)
    return chain, perturbed(chain, rng), q, chain.positions(q) + sigma * rng.normal(size=(n, 3))


def largest_error(learner, chain: RigidChain, kinds: str, revolute_deg: float = 80.0) -> float:
    q = random_q(np.random.default_rng(99), kinds, 200, revolute_deg)
    return float(np.linalg.norm(learner.predict(q) - chain.positions(q), axis=1).max())


@functools.cache
def noisy_fit():
    """Return a fit of a rough prior to 200 pairs of four joints: 10 mm of noise, 10 % outliers of about 0.3 m."""
    chain, prior, q, x = case("RRRR", 200, 5, SIGMA_M)
    x[::10] += 0.3 * np.random.default_rng(1).choice([-1.0, 1.0], size=(20, 3))
    learner = TensorLearner.around(prior, bases_for("RRRR"))
    learner.learn(q, x)
    return chain, learner, q, x


def test_the_learner_is_a_model():
    model: Model = TensorLearner(bases_for("RR"))
    assert model.joints == 2


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.soak)])
def test_seven_joints_are_exact_from_110_pairs_alone(seed):
    chain, _, q, x = case("R" * 7, 110, seed)
    learner = TensorLearner(bases_for("R" * 7))
    learner.learn(q, x)
    assert largest_error(learner, chain, "R" * 7) < 1e-9


@pytest.mark.parametrize(("kinds", "n"), [("RPRRP", 90), ("PPR", 40), ("R", 12), ("RP", 25)])
def test_mixed_chains_are_exact_from_nothing(kinds, n):
    chain, _, q, x = case(kinds, n, 11)
    learner = TensorLearner(bases_for(kinds))
    learner.learn(q, x)
    assert largest_error(learner, chain, kinds) < 1e-9


def test_twenty_joints_exact_from_prior_and_200_pairs():
    chain, prior, q, x = case("R" * 20, 200, 2)
    learner = TensorLearner.around(prior, bases_for("R" * 20))
    learner.learn(q, x)
    assert largest_error(learner, chain, "R" * 20) < 1e-9


@pytest.mark.soak
def test_five_degree_cluster_is_exact_over_eighty_degrees():
    chain, _, q, x = case("R" * 7, 150, 4, revolute_deg=5.0)
    learner = TensorLearner(bases_for("R" * 7, 5.0))
    learner.learn(q, x)
    assert largest_error(learner, chain, "R" * 7) < 1e-7


def test_thirty_noisy_pairs_more_than_halve_prior_error():
    chain, prior, q, x = case("R" * 6, 30, 8, SIGMA_M)
    learner = TensorLearner.around(prior, bases_for("R" * 6))
    before = largest_error(learner, chain, "R" * 6)
    learner.learn(q, x)
    assert largest_error(learner, chain, "R" * 6) < 0.4 * before


def test_the_noise_is_found():
    _, learner, _, _ = noisy_fit()
    assert learner.noise == pytest.approx(SIGMA_M, rel=0.15)


def test_gross_outliers_are_the_ones_left_out():
    _, learner, _, _ = noisy_fit()
    assert np.flatnonzero(learner.outliers).tolist() == list(range(0, 200, 10))


def test_outliers_cost_at_most_five_percent_accuracy():
    chain, learner, q, x = noisy_fit()
    _, prior, _, _ = case("RRRR", 200, 5, SIGMA_M)
    clean = TensorLearner.around(prior, bases_for("RRRR"))
    good = np.arange(200) % 10 != 0
    clean.learn(q[good], x[good])
    assert largest_error(learner, chain, "RRRR") <= 1.05 * largest_error(clean, chain, "RRRR")


def test_claimed_sigma_covers_two_thirds_of_errors():
    inside = []
    for seed in range(8):
        chain, prior, q, x = case("RRRR", 60, seed, SIGMA_M)
        learner = TensorLearner.around(prior, bases_for("RRRR"))
        learner.learn(q, x)
        test = random_q(np.random.default_rng(seed + 500), "RRRR", 100, 80)
        estimate = learner.estimate(test)
        inside.append(np.abs(estimate.x - chain.positions(test)) < estimate.sigma)
    assert 0.6 < np.mean(inside) < 0.85


def stretched(q):
    """Return the true joint angles: encoders eccentric by 2 degrees."""
    return q + np.radians(2.0) * np.sin(q + np.arange(q.shape[1]))


@pytest.mark.parametrize("bend", ["lens", "eccentric", "elastic"])
@pytest.mark.soak
def test_claimed_sigma_covers_truths_outside_the_model_class(bend):
    inside, inside_twice = [], []
    for seed in range(4):
        chain, prior, q, _ = case("RRRR", 400, seed)

        def truth(q, chain=chain):
            if bend == "eccentric":
                return chain.positions(stretched(q))
            x = chain.positions(q)
            if bend == "lens":
                return x + 0.1 * np.square(x).sum(axis=1, keepdims=True) * x
            # The marker weighs 5 N, each joint gives 0.01 rad/Nm.
            lever = chain.jacobian(q)
            return x - 0.05 * np.einsum("nik,nk->ni", lever, lever[:, 2])

        x = truth(q) + 0.003 * np.random.default_rng(seed).normal(size=(*q.shape[:1], 3))
        learner = TensorLearner.around(prior, bases_for("RRRR"), TensorSettings(refit_every=500))
        learner.learn(q, x)
        learner.refit()
        test = random_q(np.random.default_rng(50 + seed), "RRRR", 300, 80.0)
        off = np.abs(learner.predict(test) - truth(test)) / learner.estimate(test).sigma
        inside.append((off < 1.0).mean())
        inside_twice.append((off < 1.96).mean())
        assert learner.posterior.misfit.any()
    assert np.mean(inside) > 0.6
    assert np.mean(inside_twice) > 0.85


@pytest.mark.soak
def test_a_rigid_arm_is_seldom_taken_for_another():
    found = 0
    for seed in range(20):
        _, prior, q, x = case("RRR", 100, seed, SIGMA_M)
        learner = TensorLearner.around(prior, bases_for("RRR"), TensorSettings(refit_every=100))
        learner.learn(q, x)
        learner.refit()
        found += learner.posterior.misfit.any()
    assert found <= 5


def test_estimated_ellipse_std_beats_fixed_values():
    errors: dict[float | None, list[float]] = {None: [], 0.003: [], 0.03: []}
    for seed in range(3):
        for ellipse_std, found in errors.items():
            chain, prior, q, x = case("RRRR", 150, seed, SIGMA_M)
            settings = TensorSettings(refit_every=150)
            learner = TensorLearner.around(prior, bases_for("RRRR"), settings, ellipse_std=ellipse_std)
            learner.learn(q, x)
            learner.refit()
            found.append(largest_error(learner, chain, "RRRR"))
    assert np.mean(errors[None]) < min(np.mean(errors[0.003]), np.mean(errors[0.03]))


def test_misfit_survives_bytes():
    chain, prior, q, _ = case("RRR", 200, 3)
    learner = TensorLearner.around(prior, bases_for("RRR"), AT_ONCE)
    learner.learn(q, chain.positions(stretched(q)), 0.001)
    twin = TensorLearner.from_bytes(learner.to_bytes())
    assert learner.posterior.misfit.any()
    np.testing.assert_array_equal(twin.estimate(q).sigma, learner.estimate(q).sigma)


def test_sigma_grows_away_from_the_data():
    _, prior, q, x = case("RRRR", 200, 3, SIGMA_M, revolute_deg=20.0)
    learner = TensorLearner.around(prior, bases_for("RRRR"))
    learner.learn(q, x)
    near, far = np.full((1, 4), 0.1), np.full((1, 4), 1.4)
    assert learner.estimate(far).sigma.min() > 3.0 * learner.estimate(near).sigma.max()


def test_support_ends_where_the_data_end():
    _, _, q, x = case("RRR", 80, 3, 1e-3, revolute_deg=20.0)
    learner = TensorLearner(bases_for("RRR", 20.0))
    learner.learn(q, x)
    assert learner.estimate(np.array([np.full(3, 0.1), np.full(3, 1.4)])).in_support.tolist() == [True, False]


def test_untrained_learner_predicts_the_prior():
    _, prior, q, _ = case("RPR", 5, 0)
    assert np.allclose(TensorLearner.around(prior, bases_for("RPR")).predict(q), prior.positions(q), atol=1e-12)


def test_before_any_pair_nothing_is_in_support():
    _, prior, q, _ = case("RPR", 5, 0)
    assert not TensorLearner.around(prior, bases_for("RPR")).estimate(q).in_support.any()


def test_too_few_pairs_without_prior_are_refused():
    _, _, q, x = case("RRR", 8, 0)
    learner = TensorLearner(bases_for("RRR"), settings=AT_ONCE)
    learner.learn(q, x)
    with pytest.raises(DegenerateDataError, match=f"needs {learner.pairs_needed} pairs; 8 are kept"):
        learner.predict(q)


def test_a_given_sigma_weighs_the_pairs():
    chain, prior, q, x = case("RRR", 120, 6, 1e-3)
    bad = np.arange(120) % 2 == 0
    x[bad] += 0.1 * np.random.default_rng(0).normal(size=(60, 3))
    told, untold = (TensorLearner.around(prior, bases_for("RRR"), TensorSettings(robust=False)) for _ in range(2))
    told.learn(q, x, np.where(bad, 0.1, 1e-3))
    untold.learn(q, x)
    assert largest_error(told, chain, "RRR") < 0.2 * largest_error(untold, chain, "RRR")


def changed_tool(settings_: TensorSettings | None = None):
    """Return a learner that has seen 200 pairs, the chain after its marker moved by 200 mm, and further pairs of it."""
    chain, prior, q, x = case("RRRR", 300, 9, 1e-3)
    learner = TensorLearner.around(prior, bases_for("RRRR"), settings_)
    learner.learn(q[:200], x[:200])
    changed = chain.with_tool([0.0, 0.2, 0.0])
    return learner, changed, q[200:], changed.positions(q[200:]) + x[200:] - chain.positions(q[200:])


def test_announced_marker_move_is_learnt_from_ten_pairs():
    learner, changed, q, x = changed_tool()
    learner.tool_changed(0.2)
    learner.learn(q[:10], x[:10])
    assert largest_error(learner, changed, "RRRR") < 0.01


def test_window_follows_an_unannounced_change():
    learner, changed, q, x = changed_tool(TensorSettings(window=90))
    learner.learn(q, x)
    assert largest_error(learner, changed, "RRRR") < 0.05


def test_forgotten_pairs_no_longer_count():
    _, prior, q, x = case("RRR", 60, 3, SIGMA_M)
    learner, fresh = (TensorLearner.around(prior, bases_for("RRR"), AT_ONCE) for _ in range(2))
    learner.learn(q, x + 1.0)
    learner.forget(0)
    for each in (learner, fresh):
        each.learn(q, x, SIGMA_M)
    assert np.allclose(learner.predict(q), fresh.predict(q), atol=1e-4)


@pytest.mark.parametrize("std", [0.0, -1.0, float("nan")])
def test_a_marker_moved_by_no_spread_is_refused(std):
    _, prior, _, _ = case("RR", 1, 0)
    with pytest.raises(SettingError):
        TensorLearner.around(prior, bases_for("RR")).tool_changed(std)


def test_a_window_keeps_no_more_than_its_pairs():
    _, prior, q, x = case("RR", 60, 0)
    learner = TensorLearner.around(prior, bases_for("RR"), TensorSettings(window=40))
    learner.learn(q, x)
    assert (learner.kept, learner.pairs) == (40, 60)


def test_gauge_of_prior_does_not_affect_predictions():
    """Turning the frame between two links, mean and covariance alike, gives the same prior."""
    _, prior, q, x = case("RR", 60, 1, SIGMA_M)
    bases = bases_for("RR")
    turn = random_small_turn(np.random.default_rng(0), 2.0)
    given_ = CorePrior.vague(2, 0.3)
    linear = np.eye(4)
    linear[:3, :3] = turn
    mean = TensorLearner.around(prior, bases).train.cores.reshape(2, 36)
    right, left = np.kron(np.eye(9), linear.T), np.kron(np.eye(3), np.kron(turn.T, np.eye(4)))
    turned_mean = np.stack([right @ mean[0], left @ mean[1]])
    turned_spread = np.stack([right @ given_.spread[0], left @ given_.spread[1]])
    learners = [
        TensorLearner(bases, CorePrior(mean, given_.spread)),
        TensorLearner(bases, CorePrior(turned_mean, turned_spread)),
    ]
    for learner in learners:
        learner.learn(q, x)
    assert np.allclose(learners[0].predict(q), learners[1].predict(q), atol=1e-5)


@pytest.mark.parametrize(
    ("q", "x", "sigma", "error"),
    [
        (np.zeros((3, 2)), np.zeros((2, 3)), None, ShapeError),
        (np.zeros((3, 4)), np.zeros((3, 3)), None, ShapeError),
        (np.full((3, 2), np.nan), np.zeros((3, 3)), None, NonFiniteError),
        (np.zeros((3, 2)), np.full((3, 3), np.inf), None, NonFiniteError),
        (np.zeros((3, 2)), np.zeros((3, 3)), 0.0, SettingError),
        (np.zeros((3, 2)), np.zeros((3, 3)), [1.0, 2.0], ShapeError),
        (np.zeros((3, 2)), np.zeros((3, 3)), np.nan, NonFiniteError),
    ],
)
def test_bad_input_changes_nothing(q, x, sigma, error):
    _, prior, good_q, good_x = case("RR", 30, 0, SIGMA_M)
    learner = TensorLearner.around(prior, bases_for("RR"), AT_ONCE)
    learner.learn(good_q, good_x)
    before = learner.to_bytes()
    with pytest.raises(error):
        learner.learn(q, x, sigma)
    assert learner.to_bytes() == before


@pytest.mark.parametrize("setting", [{"window": 0}, {"refit_every": 0}, {"starts": 0}, {"seed": -1}])
def test_impossible_settings_are_refused(setting):
    with pytest.raises(SettingError, match=next(iter(setting))):
        TensorSettings(**setting)


def test_a_prior_without_spread_is_refused():
    with pytest.raises(SettingError, match="ellipse_std"):
        TensorLearner.around(random_chain(np.random.default_rng(0), "RR"), bases_for("RR"), ellipse_std=0.0)


def test_a_prior_of_other_joints_is_refused():
    with pytest.raises(ShapeError):
        TensorLearner(bases_for("RRR"), CorePrior.vague(2, 0.3))


def test_chain_mismatched_with_bases_is_refused():
    with pytest.raises(BasisError):
        TensorLearner.around(random_chain(np.random.default_rng(0), "RP"), bases_for("RR"))


def test_restored_learner_continues_bit_for_bit():
    _, prior, q, x = case("RPR", 120, 2, SIGMA_M)
    learner = TensorLearner.around(prior, bases_for("RPR"))
    learner.learn(q[:70], x[:70])
    back = TensorLearner.from_bytes(learner.to_bytes())
    for each in (learner, back):
        each.learn(q[70:], x[70:], 0.02)
    assert back.to_bytes() == learner.to_bytes()


def test_a_restored_learner_claims_the_same_sigma():
    _, learner, q, _ = noisy_fit()
    back = TensorLearner.from_bytes(learner.to_bytes())
    assert np.array_equal(back.estimate(q).sigma, learner.estimate(q).sigma)


@given(position=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
def test_a_single_changed_byte_is_noticed(position, flip):
    damaged = bytearray(stored_learner())
    damaged[int(position * len(damaged))] ^= flip
    with pytest.raises(ModelFormatError):
        TensorLearner.from_bytes(bytes(damaged))


@functools.cache
def stored_learner() -> bytes:
    _, prior, q, x = case("RR", 30, 0, SIGMA_M)
    learner = TensorLearner.around(prior, bases_for("RR"))
    learner.learn(q, x)
    return learner.to_bytes()


def test_a_stored_train_is_no_learner():
    _, learner, _, _ = noisy_fit()
    with pytest.raises(ModelFormatError):
        TensorLearner.from_bytes(learner.train.to_bytes())


def test_outliers_among_pairs_exact_in_prior_are_rejected():
    rng = np.random.default_rng(12)
    learner = TensorLearner.around(random_chain(rng, "RRR"), bases_for("RRR"), ellipse_std=1e-3)
    q = random_q(rng, "RRR", 60, 80.0)
    x = learner.predict(q)
    x[:5] += 0.1
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        learner.learn(q, x)
    np.testing.assert_array_equal(np.flatnonzero(learner.outliers), np.arange(5))
