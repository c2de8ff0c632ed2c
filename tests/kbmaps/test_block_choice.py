from __future__ import annotations

import numpy as np
import pytest
from planted_chains import random_chain

from kbmaps import (
    ExactLearner,
    KBMap,
    NonFiniteError,
    RigidChain,
    ShapeError,
    blockwise_precision,
    follow_a_path,
    learning_bases,
)
from kbmaps.arrays import FloatArray

JOINTS = 4
STEP = np.radians(2.0)
SEEDS = range(10)


def path(rng: np.random.Generator, count: int, joints: int = JOINTS) -> FloatArray:
    """Return straight paths between random waypoints, (count, joints) [rad]."""
    q, goal = [np.zeros(joints)], rng.uniform(-1.0, 1.0, joints)
    while len(q) < count:
        if np.linalg.norm(goal - q[-1]) < STEP:
            goal = rng.uniform(-1.0, 1.0, joints)
        way = goal - q[-1]
        q.append(q[-1] + STEP * way / np.linalg.norm(way))
    return np.array(q)


def shared_errors(rng: np.random.Generator, count: int, sigma_m: float, memory: float = 0.9) -> FloatArray:
    """Return measurement errors (count, 3) [m] that are strongly correlated between neighbours."""
    fresh = rng.normal(size=(count, 3))
    errors = [fresh[0]]
    for row in fresh[1:]:
        errors.append(memory * errors[-1] + np.sqrt(1.0 - memory**2) * row)
    return sigma_m * np.array(errors)


def wrong_prior(chain: RigidChain) -> KBMap:
    """Return the map of the chain with its marker and its frame a few centimetres off."""
    bases = learning_bases(np.full(chain.joints, -np.pi), np.full(chain.joints, np.pi))
    fixed = chain.fixed.copy()
    fixed[0, :3, 3] += [0.02, -0.03, 0.01]
    fixed[1:, :3, 3] += 0.01
    return RigidChain(fixed, chain.axes, chain.prismatic).to_kbmap(bases)


def kernel_scale(prior: KBMap, q: FloatArray) -> float:
    """Return the mean squared length of the weight vectors at q."""
    return float(np.square(prior.weights(q)).sum(axis=1).mean())


def test_two_degree_steps_count_as_a_path() -> None:
    prior = wrong_prior(random_chain(np.random.default_rng(0), "R" * JOINTS))
    assert follow_a_path(prior, path(np.random.default_rng(0), 100))


@pytest.mark.parametrize("seed", SEEDS)
def test_poses_chosen_at_random_are_no_path(seed: int) -> None:
    prior = wrong_prior(random_chain(np.random.default_rng(seed), "R" * JOINTS))
    assert not follow_a_path(prior, np.random.default_rng(seed).uniform(-1.5, 1.5, (100, JOINTS)))


@pytest.mark.parametrize("seed", SEEDS)
def test_sweep_in_25_degree_steps_is_no_path(seed: int) -> None:
    prior = wrong_prior(random_chain(np.random.default_rng(seed), "R" * JOINTS))
    assert not follow_a_path(prior, 12.5 * path(np.random.default_rng(seed), 100))


def test_one_pair_is_no_path() -> None:
    prior = wrong_prior(random_chain(np.random.default_rng(0), "R" * JOINTS))
    assert not follow_a_path(prior, np.zeros((1, JOINTS)))


def test_too_few_pairs_for_blocks_trust_the_prior() -> None:
    rng = np.random.default_rng(0)
    prior = wrong_prior(random_chain(rng, "R" * JOINTS))
    q = path(rng, 100)
    scale = kernel_scale(prior, q)
    assert blockwise_precision(prior, q, np.zeros((100, 3))) == pytest.approx(1e-3 * scale)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 3))])
def test_blockwise_precision_matches_refits_without_each_block(seed: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, "RR")
    prior, q = wrong_prior(chain), path(rng, 120, joints=2)
    x = chain.positions(q) + shared_errors(rng, 120, 0.003)
    blocks = np.arange(120).reshape(4, 30)
    tried = kernel_scale(prior, q) * 10.0 ** np.arange(-13.0, 3.25, 0.5)

    def left_out_m(precision: float) -> list[float]:
        means = []
        for block in blocks:
            others = np.setdiff1d(np.arange(120), block)
            learner = ExactLearner(prior)
            learner.learn(q[others], x[others])
            miss = learner.solve(precision).map.predict(q[block]) - x[block]
            means.append(float(np.linalg.norm(miss, axis=1).mean()))
        return means

    errors = np.array([left_out_m(precision) for precision in tried if precision > 1e-9])
    tried = tried[tried > 1e-9]
    means = errors.mean(axis=1)
    limit = means.min() + errors[means.argmin()].std(ddof=1) / 2.0
    largest = tried[np.flatnonzero(means <= limit)[-1]]
    assert blockwise_precision(prior, q, x) == pytest.approx(largest)


def test_blockwise_precision_beats_evidence_under_correlated_errors() -> None:
    ratios = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        chain = random_chain(rng, "R" * JOINTS)
        prior, q = wrong_prior(chain), path(rng, 300)
        x = chain.positions(q) + shared_errors(rng, len(q), 0.003)
        learner = ExactLearner(prior)
        learner.learn(q, x)
        beside = q + rng.normal(0.0, np.radians(3.0), q.shape)
        blocks, evidence = (
            np.linalg.norm(learner.solve(choice).map.predict(beside) - chain.positions(beside), axis=1).mean()
            for choice in (blockwise_precision(prior, q, x), "evidence")
        )
        ratios.append(blocks / evidence)
    assert np.median(ratios) < 0.9, np.round(ratios, 2)
    assert max(ratios) < 1.3, np.round(ratios, 2)


def test_mismatched_numbers_of_positions_and_angles_are_refused() -> None:
    prior = wrong_prior(random_chain(np.random.default_rng(0), "R" * JOINTS))
    with pytest.raises(ShapeError, match=r"to go with q"):
        blockwise_precision(prior, np.zeros((5, JOINTS)), np.zeros((4, 3)))


def test_angles_that_are_not_finite_are_refused() -> None:
    prior = wrong_prior(random_chain(np.random.default_rng(0), "R" * JOINTS))
    with pytest.raises(NonFiniteError):
        blockwise_precision(prior, np.full((5, JOINTS), np.nan), np.zeros((5, 3)))
