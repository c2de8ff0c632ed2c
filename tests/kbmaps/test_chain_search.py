from __future__ import annotations

import numpy as np
import pytest
from planted_chains import random_chain, random_q

from kbmaps import ChainTolerances, DegenerateDataError, RigidLearner, SettingError, ShapeError, find_chain
from kbmaps.chains.search import Descents, ScrewArms


@pytest.mark.parametrize("kinds", ["RRRRRRR", "RRRRRR", "RRPRR"])
def test_chain_is_found_from_sixty_exact_pairs_alone(kinds):
    found = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        chain = random_chain(rng, kinds)
        q = random_q(rng, kinds, 60, 80)
        prismatic = [kind == "P" for kind in kinds]
        test = random_q(rng, kinds, 50, 80)
        guess = find_chain(q, chain.positions(q), prismatic, rng=rng)
        found += bool(np.allclose(guess.positions(test), chain.positions(test), rtol=0, atol=1e-7))
    assert found == 4


def test_found_chain_initialises_a_learner_without_prior():
    rng = np.random.default_rng(0)
    chain = random_chain(rng, "RRRRRR")
    q = random_q(rng, "RRRRRR", 300, 80)
    x = chain.positions(q) + 0.01 * rng.normal(size=q[:, :3].shape)
    learner = RigidLearner(
        find_chain(q, x, rng=rng, sigma=0.01), ChainTolerances(axes=np.inf, points=np.inf, tool=np.inf)
    )
    learner.learn(q, x, 0.01)
    test = random_q(rng, "RRRRRR", 300, 80)
    assert np.linalg.norm(learner.predict(test) - chain.positions(test), axis=1).mean() < 0.0045


@pytest.mark.parametrize("kinds", ["RRRR", "RPRR"])
def test_descent_result_is_independent_of_parallel_descents(kinds):
    rng = np.random.default_rng(3)
    chain, slides = random_chain(rng, kinds), np.array([kind == "P" for kind in kinds])
    q = random_q(rng, kinds, 30, 80)
    x = chain.positions(q) + 0.01 * rng.normal(size=(30, 3))
    axes = rng.normal(size=(3, 4, 3))
    starts = ScrewArms(axes / np.linalg.norm(axes, axis=2, keepdims=True), x.mean(axis=0) + rng.normal(size=(3, 5, 3)))
    descents = Descents(q, x, slides, 0.3)
    together, rms = descents.run(starts, 0.0)
    for index in range(3):
        _, own = descents.run(starts[np.array([index])], 0.0)
        np.testing.assert_allclose(rms[index], own[0], rtol=1e-6)
        off = together.chain(index, slides).positions(q) - x
        np.testing.assert_allclose(rms[index], np.sqrt(np.square(off).sum(axis=1).mean()), rtol=1e-9)


def test_the_same_generator_finds_the_same_chain():
    chain = random_chain(np.random.default_rng(2), "RRR")
    q = random_q(np.random.default_rng(3), "RRR", 20, 80)
    x = chain.positions(q) + 0.001 * np.random.default_rng(4).normal(size=(20, 3))
    first, second = (find_chain(q, x, rng=np.random.default_rng(5), starts=3) for _ in range(2))
    np.testing.assert_array_equal(first.fixed, second.fixed)


def test_too_few_pairs_error_states_number_needed():
    with pytest.raises(DegenerateDataError, match="record 11"):
        find_chain(np.zeros((10, 7)), np.zeros((10, 3)), rng=np.random.default_rng(0))


def test_positions_in_one_place_are_refused():
    with pytest.raises(DegenerateDataError, match="one place"):
        find_chain(np.zeros((30, 3)), np.ones((30, 3)), rng=np.random.default_rng(0))


@pytest.mark.parametrize(
    ("settings", "error"),
    [({"starts": 0}, SettingError), ({"sigma": 0.0}, SettingError), ({"prismatic": [True]}, ShapeError)],
)
def test_impossible_settings_are_refused(settings, error):
    with pytest.raises(error):
        find_chain(np.zeros((30, 3)), np.ones((30, 3)), rng=np.random.default_rng(0), **settings)


def test_seed_instead_of_generator_error_names_default_rng():
    with pytest.raises(SettingError, match="default_rng"):
        find_chain(np.zeros((20, 2)), np.zeros((20, 3)), rng=0)
