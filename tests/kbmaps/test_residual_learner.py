"""The rigid chain with residual: as good as the chain on a rigid arm, better on others, with a valid uncertainty."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from planted_chains import random_q
from rough_arms import ROUGH, Arm, rough_arm

from kbmaps import (
    ChainTolerances,
    ModelFormatError,
    NonFiniteError,
    ResidualLearner,
    ResidualModel,
    RigidLearner,
    SettingError,
    ShapeError,
)
from kbmaps.chains.parameters import ChainParameters
from kbmaps.residual.evidence import GroupedModel, Moments
from kbmaps.residual.features import ResidualFeatures, ResidualScaling

SIGMA = 0.005


def eccentric(q: np.ndarray) -> np.ndarray:
    return q + np.radians(1.0) * np.sin(q + 1.0)


def loaded(arm: Arm, q: np.ndarray, weight: float) -> np.ndarray:
    """Return the joint angles under a weight at the marker, each joint a spring, after a hundred small steps."""
    down = np.array([0.2, -0.3, -0.9])
    yielded = q.copy()
    for _ in range(100):
        torques = np.einsum("nij,i->nj", arm.real.jacobian(yielded), down)
        yielded += 0.2 * (q + weight * torques - yielded)
    return arm.real.positions(yielded)


def taught(arm: Arm, q: np.ndarray, x: np.ndarray, sigma: float | None = None) -> ResidualLearner:
    learner = ResidualLearner(arm.nominal, ROUGH)
    learner.learn(q, x, sigma)
    return learner


def mean_distance(x: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(x - truth, axis=1).mean())


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def arm(rng: np.random.Generator) -> Arm:
    return rough_arm(rng)


@pytest.fixture
def bent(arm: Arm, rng: np.random.Generator) -> ResidualLearner:
    """Return a learner trained on an arm with eccentric encoders."""
    q = random_q(rng, arm.kinds, 200, 80.0)
    return taught(arm, q, arm.real.positions(eccentric(q)) + SIGMA * rng.normal(size=(200, 3)))


def test_noise_free_rigid_arm_equals_rigid_learner_exactly(arm, rng):
    q, x = arm.pairs(rng, 40)
    rigid = RigidLearner(arm.nominal, ROUGH)
    rigid.learn(q, x)
    assert np.array_equal(taught(arm, q, x).predict(q), rigid.predict(q))


@functools.cache
def of_rigid_arms() -> list[tuple[ResidualLearner, float]]:
    """Return learners of rigid arms with noise, and their RMS deviation from the rigid chain over its sigma."""
    learners = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng, "RRRR")
        learner = taught(arm, *arm.pairs(rng, 60, SIGMA))
        q, _ = arm.pairs(rng, 200)
        moved, sigma = learner.predict(q) - learner.rigid.predict(q), learner.rigid.estimate(q).sigma
        learners.append((learner, math.sqrt(np.square(moved).mean() / np.square(sigma).mean())))
    return learners


def test_without_deviations_predictions_stay_near_rigid_chain():
    shares = [share for learner, share in of_rigid_arms() if not learner.deviations]
    assert len(shares) >= 8
    assert max(shares) < 0.5


def test_deviations_are_those_that_the_pairs_speak_for():
    """Deviations with a small weight in the average do not count."""
    averaged = [learner for learner, share in of_rigid_arms() if share > 0.0]
    assert any(set(learner.model.weights) > set(learner.deviations) for learner in averaged)


@pytest.mark.parametrize("told", [None, SIGMA])
@pytest.mark.parametrize("pairs", [1, 4, 40])
def test_rigid_prior_gives_same_estimates_as_rigid_learner(arm, rng, pairs, told):
    before = RigidLearner(arm.nominal, ROUGH)
    before.learn(*arm.pairs(rng, 30), SIGMA)
    belief = before.belief.with_other_tool(0.1)
    learner = ResidualLearner(arm.nominal, ROUGH, ResidualModel.of_belief(belief))
    rigid = RigidLearner(arm.nominal, ROUGH, belief)
    q, x = arm.pairs(rng, pairs)
    for one in (learner, rigid):
        one.learn(q, x, told)
    mine, theirs = learner.estimate(q), rigid.estimate(q)
    np.testing.assert_array_equal(mine.x, theirs.x)
    np.testing.assert_array_equal(mine.sigma, theirs.sigma)
    np.testing.assert_array_equal(mine.in_support, theirs.in_support)


def test_residual_costs_under_ten_percent_on_rigid_arms():
    ratios = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng)
        learner = taught(arm, *arm.pairs(rng, 100, SIGMA))
        test, truth = arm.pairs(rng, 300)
        ratios.append(mean_distance(learner.predict(test), truth) / mean_distance(learner.rigid.predict(test), truth))
    assert np.exp(np.log(ratios).mean()) < 1.1


def test_eccentric_encoders_are_learnt_exactly_without_noise(arm, rng):
    q, test = random_q(rng, arm.kinds, 100, 80.0), random_q(rng, arm.kinds, 100, 80.0)
    learner = taught(arm, q, arm.real.positions(eccentric(q)))
    assert mean_distance(learner.predict(test), arm.real.positions(eccentric(test))) < 1e-8


def test_the_cause_of_a_deviation_is_named(bent):
    assert max(bent.deviations, key=lambda group: bent.deviations[group]) == "eccentricity"


def test_joint_compliance_is_learnt_beyond_rigid_chain(arm, rng):
    q, test = random_q(rng, arm.kinds, 300, 60.0), random_q(rng, arm.kinds, 300, 60.0)
    learner = taught(arm, q, loaded(arm, q, 0.05) + SIGMA * rng.normal(size=(300, 3)))
    truth = loaded(arm, test, 0.05)
    assert mean_distance(learner.predict(test), truth) < 0.5 * mean_distance(learner.rigid.predict(test), truth)


def test_camera_axis_scaling_is_learnt_beyond_rigid_chain(arm, rng):
    stretch = np.diag([1.03, 0.98, 1.02])
    q, x = arm.pairs(rng, 200)
    test, truth = arm.pairs(rng, 300)
    learner = taught(arm, q, x @ stretch + SIGMA * rng.normal(size=x.shape))
    rigid = mean_distance(learner.rigid.predict(test), truth @ stretch)
    assert mean_distance(learner.predict(test), truth @ stretch) < 0.5 * rigid


def test_prismatic_joint_gain_is_learnt_beyond_rigid_chain(rng):
    arm = rough_arm(rng, "RPRRP")
    factor = np.array([1.0, 1.03, 1.0, 1.0, 0.97])
    q, test = random_q(rng, arm.kinds, 200, 80.0), random_q(rng, arm.kinds, 200, 80.0)
    learner = taught(arm, q, arm.real.positions(factor * q) + 0.001 * rng.normal(size=(200, 3)))
    truth = arm.real.positions(factor * test)
    assert mean_distance(learner.predict(test), truth) < 0.3 * mean_distance(learner.rigid.predict(test), truth)


@pytest.mark.soak
def test_twenty_eccentric_encoders_are_learnt_beyond_rigid_chain(rng):
    arm = rough_arm(rng, "R" * 20)
    q, test = random_q(rng, arm.kinds, 600, 60.0), random_q(rng, arm.kinds, 200, 60.0)
    learner = taught(arm, q, arm.real.positions(eccentric(q)) + SIGMA * rng.normal(size=(600, 3)))
    truth = arm.real.positions(eccentric(test))
    assert mean_distance(learner.predict(test), truth) < 0.5 * mean_distance(learner.rigid.predict(test), truth)


@pytest.mark.parametrize("told", [None, pytest.param(SIGMA, marks=pytest.mark.soak)])
def test_sigma_covers_eccentric_arms_at_68_and_95(told):
    ratios = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng)
        q, test = random_q(rng, arm.kinds, 150, 60.0), random_q(rng, arm.kinds, 200, 80.0)
        learner = taught(arm, q, arm.real.positions(eccentric(q)) + SIGMA * rng.normal(size=(150, 3)), told)
        estimate = learner.estimate(test)
        ratios.append(np.abs(estimate.x - arm.real.positions(eccentric(test))) / estimate.sigma)
    assert 0.6 < np.mean(np.array(ratios) < 1.0) < 0.78
    assert 0.9 < np.mean(np.array(ratios) < 1.96) < 0.99


def test_sigma_grows_away_from_the_data(arm, rng):
    q = random_q(rng, arm.kinds, 150, 30.0)
    learner = taught(arm, q, arm.real.positions(eccentric(q)) + SIGMA * rng.normal(size=(150, 3)))
    near, far = (learner.estimate(random_q(rng, arm.kinds, 200, reach)).sigma.mean() for reach in (30.0, 90.0))
    assert far > 2.0 * near


def test_poses_far_from_data_are_not_in_support(arm, rng):
    q = random_q(rng, arm.kinds, 150, 20.0)
    learner = taught(arm, q, arm.real.positions(eccentric(q)) + SIGMA * rng.normal(size=(150, 3)))
    assert learner.estimate(q).in_support.all()
    assert learner.estimate(random_q(rng, arm.kinds, 200, 120.0)).in_support.mean() < 0.1


def test_gross_outliers_are_left_out(arm, rng):
    q, test = random_q(rng, arm.kinds, 200, 80.0), random_q(rng, arm.kinds, 200, 80.0)
    x = arm.real.positions(eccentric(q)) + SIGMA * rng.normal(size=(200, 3))
    x[:30] += 0.2
    learner, truth = taught(arm, q, x), arm.real.positions(eccentric(test))
    assert not learner.inliers[:30].any()
    assert mean_distance(learner.predict(test), truth) < 1.1 * mean_distance(
        taught(arm, q[30:], x[30:]).predict(test), truth
    )


def test_an_arm_placed_anywhere_is_learnt(arm, rng):
    q, x = arm.pairs(rng, 200, SIGMA)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    free = ChainTolerances(ROUGH.axes, ROUGH.points, tool=math.inf, base_rotation=math.inf, base_translation=math.inf)
    learner = ResidualLearner(arm.nominal, free)
    learner.learn(q, x @ turn.T + 3.0)
    test, truth = arm.pairs(rng, 200)
    assert mean_distance(learner.predict(test), truth @ turn.T + 3.0) < SIGMA


def test_correlated_path_errors_are_not_fitted_as_residual(arm, rng):
    steps = np.cumsum(rng.normal(0.0, np.radians(0.7), (250, 6)), axis=0)
    drift = np.cumsum(rng.normal(0.0, 0.0007, (250, 3)), axis=0)
    q = steps - steps.mean(axis=0)
    learner = taught(arm, q, arm.real.positions(q) + drift + 0.002 * rng.normal(size=(250, 3)))
    test = q[rng.integers(0, 250, 300)] + rng.normal(0.0, np.radians(5.0), (300, 6))
    truth = arm.real.positions(test)
    assert mean_distance(learner.predict(test), truth) < 1.5 * mean_distance(learner.rigid.predict(test), truth)


@pytest.mark.parametrize("pairs", [0, 1, 5])
def test_up_to_five_pairs_predictions_equal_rigid_chain(arm, rng, pairs):
    q, x = arm.pairs(rng, pairs, SIGMA)
    learner = taught(arm, q, x)
    assert np.array_equal(learner.predict(q), learner.rigid.predict(q))


def test_one_configuration_is_predicted_as_in_a_batch(bent, rng):
    q = random_q(rng, "RRRRRR", 5, 80.0)
    np.testing.assert_allclose(bent.predict(q[0]), bent.predict(q)[0], rtol=0.0, atol=1e-12)


def test_estimate_gives_the_same_positions_as_predict(bent, rng):
    q = random_q(rng, "RRRRRR", 5, 80.0)
    np.testing.assert_allclose(bent.estimate(q).x, bent.predict(q), rtol=0.0, atol=1e-12)


def test_order_of_pairs_does_not_matter(arm, rng):
    q = random_q(rng, arm.kinds, 120, 80.0)
    x = arm.real.positions(eccentric(q)) + SIGMA * rng.normal(size=(120, 3))
    order = rng.permutation(120)
    np.testing.assert_allclose(
        taught(arm, q, x).predict(q), taught(arm, q[order], x[order]).predict(q), rtol=0.0, atol=1e-7
    )


def test_bytes_restore_predictions_bit_for_bit(bent, rng):
    q = random_q(rng, "RRRRRR", 20, 80.0)
    assert np.array_equal(ResidualLearner.from_bytes(bent.to_bytes()).predict(q), bent.predict(q))


def test_bytes_keep_track_of_missing_sigmas(arm, rng):
    q, x = arm.pairs(rng, 60, SIGMA)
    learner = taught(arm, q[:30], x[:30], SIGMA)
    learner.learn(q[30:], x[30:])
    again = ResidualLearner.from_bytes(learner.to_bytes())
    assert np.array_equal(again.estimate(q).sigma, learner.estimate(q).sigma)


def test_an_untaught_learner_survives_its_bytes(arm):
    assert ResidualLearner.from_bytes(ResidualLearner(arm.nominal, ROUGH).to_bytes()).pairs == 0


def test_bytes_of_another_model_are_refused(arm):
    with pytest.raises(ModelFormatError, match="rigid chain with residual"):
        ResidualLearner.from_bytes(RigidLearner(arm.nominal, ROUGH).to_bytes())


@pytest.mark.parametrize(
    ("q", "x", "sigma", "error"),
    [
        (np.zeros((2, 5)), np.zeros((2, 3)), None, ShapeError),
        (np.zeros((2, 6)), np.full((2, 3), np.nan), None, NonFiniteError),
        (np.zeros((2, 6)), np.zeros((2, 3)), 0.0, SettingError),
    ],
)
def test_refused_pairs_change_nothing(bent, q, x, sigma, error):
    with pytest.raises(error):
        bent.learn(q, x, sigma)
    assert bent.pairs == bent.rigid.pairs == 200


@pytest.mark.parametrize("kinds", ["RRRRRR", "RPRRP", "R" * 9])
def test_derivatives_of_every_group_agree_with_differences(rng, kinds):
    arm = rough_arm(rng, kinds)
    q = random_q(rng, kinds, 8, 60.0)
    parameters = ChainParameters(arm.nominal)
    features = ResidualFeatures(parameters, ResidualScaling.of(q, arm.real.positions(q)))
    chain = parameters.chain(arm.change)
    for group in features.groups():
        weights = {group: 1e-6 * rng.normal(size=features.size(group))}
        point = features.linearised(arm.change, chain, {}, q, (group,))
        moved = features.positions(chain, weights, q) - point.x
        np.testing.assert_allclose(point.groups[group] @ weights[group], moved, rtol=1e-3, atol=1e-10)


def test_selection_keeps_explaining_group_and_drops_noise_group(rng):
    design = rng.normal(size=(300, 12))
    target = design[:, 2:7] @ rng.normal(size=5) + 0.1 * rng.normal(size=300)
    columns = {"": slice(0, 2), "true": slice(2, 7), "idle": slice(7, 12)}
    model = GroupedModel(Moments.of(design, target), columns, np.zeros(2), least_noise=1e-9, noise=1.0)
    model.select(("true", "idle"))
    assert set(model.variances) == {"true"}
    assert model.noise == pytest.approx(0.1, rel=0.15)


def test_log_evidence_equals_dense_gaussian_likelihood(rng):
    design, target = rng.normal(size=(9, 4)), rng.normal(size=9)
    columns = {"": slice(0, 1), "group": slice(1, 4)}
    model = GroupedModel(Moments.of(design, target), columns, np.array([0.3]), least_noise=1e-9, noise=0.7)
    prior = np.diag([1.0, 2.5, 2.5, 2.5])
    covariance = design @ prior @ design.T + 0.49 * np.eye(9)
    offset = target - 0.3 * design[:, 0]
    dense = -0.5 * (offset @ np.linalg.solve(covariance, offset) + np.linalg.slogdet(covariance)[1])
    assert model.posterior(active={"group": 2.5}).log_evidence == pytest.approx(dense, abs=1e-9)


def test_model_average_variance_includes_distance_between_means(rng):
    design = rng.normal(size=(20, 3))
    target = 0.3 * design[:, 1] + rng.normal(size=20)
    columns = {"": slice(0, 1), "first": slice(1, 2), "second": slice(2, 3)}
    model = GroupedModel(Moments.of(design, target), columns, np.zeros(1), least_noise=1e-9, noise=1.0)
    model.variances = {"first": 0.5}
    average = model.average(())
    lone, both = model.posterior(active={}), model.posterior()
    share = 1.0 / (1.0 + math.exp(lone.log_evidence - both.log_evidence + 2.0))
    apart = share * (1.0 - share) * both.mean[1] ** 2
    expected = share * float(np.square(both.spread[1]).sum()) + apart
    assert float(np.square(average.spread[1]).sum()) == pytest.approx(expected)
