from __future__ import annotations

import numpy as np
import pytest
from guided_arm import Scene, nominal_model

from bodyschema.learning.model_bank import INSTANT, ModelBank

SCENE = Scene.draw(0, 20)
X = np.array([pair.x for pair in SCENE.pairs])


@pytest.fixture
def members() -> ModelBank:
    members = ModelBank(nominal_model().prior)
    members.replay(SCENE.q, X)
    return members


def test_taking_the_instant_map_leaves_predictions_unchanged(members: ModelBank) -> None:
    before = members.predict(INSTANT, SCENE.q)
    np.testing.assert_array_equal(members.map(INSTANT).predict(SCENE.q), before)
    np.testing.assert_array_equal(members.predict(INSTANT, SCENE.q), before)


def test_taken_map_is_unaffected_by_later_learning(members: ModelBank) -> None:
    taken = members.map(INSTANT)
    before = taken.predict(SCENE.q)
    members.learn(SCENE.q[0], np.ones(3), np.inf)
    np.testing.assert_array_equal(taken.predict(SCENE.q), before)
    assert (members.map(INSTANT).predict(SCENE.q[0]) != before[0]).all()


@pytest.mark.parametrize("asked_for", ["prediction", "map"])
def test_overflowed_instant_learner_restarts_at_the_prior(members: ModelBank, asked_for: str) -> None:
    here = np.repeat(SCENE.q[:1], 4, axis=0)
    with np.errstate(all="ignore"):
        members.replay(here, 1.7e308 * np.array([1.0, -1.0, 1.0, -1.0])[:, None] * np.ones(3))
        predicted = members.predict(INSTANT, SCENE.q) if asked_for == "prediction" else None
    if predicted is None:
        predicted = members.map(INSTANT).predict(SCENE.q)
    np.testing.assert_array_equal(predicted, members.prior.predict(SCENE.q))
