from __future__ import annotations

import numpy as np
import pytest
from rough_arms import ROUGH, rough_arm

from kbmaps import ChainPosterior, RigidLearner, SettingError, ShapeError, systematic_error


def found(seed, pairs, eccentric_deg):
    """Return the estimated effect of eccentric encoders and the true one on other poses of the same kind [m]."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng)
    phase = rng.uniform(-np.pi, np.pi, 6)

    def read(q):
        return q + np.radians(eccentric_deg) * np.sin(q + phase)

    q, _ = arm.pairs(rng, pairs)
    x = arm.real.positions(read(q)) + 0.01 * rng.normal(size=(pairs, 3))
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(q, x)
    test, _ = arm.pairs(rng, 500)
    error = np.square(learner.predict(test) - arm.real.positions(read(test))).mean()
    return systematic_error(ChainPosterior.of(learner), q, x - learner.predict(q)), np.sqrt(error)


def test_most_of_what_a_rigid_chain_cannot_follow_is_found_and_not_more():
    pairs = [found(seed, 500, 2.0) for seed in range(8)]
    shares = np.array([ours / true for ours, true in pairs])
    assert 0.5 < shares.mean() < 1.0


def test_of_noise_alone_little_is_taken_for_systematic():
    rng = np.random.default_rng(0)
    taken = []
    for _ in range(40):
        arm = rough_arm(rng)
        q, x = arm.pairs(rng, 100, 0.01)
        learner = RigidLearner(arm.nominal, ROUGH)
        learner.learn(q, x)
        taken.append(systematic_error(ChainPosterior.of(learner), q, x - learner.predict(q)))
    # Two standard errors are passed by chance in 2 of 100.
    assert np.mean(np.array(taken) > 0.0) <= 0.125


@pytest.mark.parametrize("pairs", [0, 1, 5])
def test_too_few_pairs_say_nothing(pairs):
    rng = np.random.default_rng(1)
    arm = rough_arm(rng)
    posterior = ChainPosterior.of(RigidLearner(arm.nominal, ROUGH), noise=0.01)
    q, _ = arm.pairs(rng, pairs)
    assert systematic_error(posterior, q, np.ones((pairs, 3))) == 0.0


def test_poses_taken_many_times_are_neighbours_of_each_other():
    rng = np.random.default_rng(2)
    arm = rough_arm(rng)
    posterior = ChainPosterior.of(RigidLearner(arm.nominal, ROUGH), noise=0.01)
    q, _ = arm.pairs(rng, 20)
    shared = 0.3 * rng.normal(size=(20, 3))
    wanted = np.sqrt((np.square(shared).sum() + np.square(posterior.roots(q)).sum()) / 60)
    assert systematic_error(posterior, np.tile(q, (2, 1)), np.tile(shared, (2, 1))) == pytest.approx(wanted)


def test_the_floor_found_is_the_least_error_of_a_posterior_with_it():
    rng = np.random.default_rng(3)
    arm = rough_arm(rng)
    posterior = ChainPosterior.of(RigidLearner(arm.nominal, ROUGH), noise=0.01)
    changed = posterior.with_floor(0.004)
    assert (changed.floor, posterior.floor, changed.noise) == (0.004, 0.0, 0.01)
    with pytest.raises(SettingError):
        posterior.with_floor(-1.0)


def test_poses_and_residuals_must_fit():
    rng = np.random.default_rng(4)
    arm = rough_arm(rng)
    posterior = ChainPosterior.of(RigidLearner(arm.nominal, ROUGH), noise=0.01)
    q, _ = arm.pairs(rng, 5)
    with pytest.raises(ShapeError):
        systematic_error(posterior, q, np.zeros((4, 3)))
