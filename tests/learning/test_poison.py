"""Implausible pairs: the learner rejects them or marks them as outliers, reports it, and still answers numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from guided_arm import NOW_AND_THEN, Scene, new_learning, nominal_model, teach

from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.records import Pair, frozen_array
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver
from bodyschema.learning.state import LearningState, StateError

TAUGHT = 40
Spoil = Callable[[Pair], Pair]


def with_q(value: float) -> Spoil:
    return lambda pair: replace(pair, q=frozen_array(np.full_like(pair.q, value)))


def with_x(value: float) -> Spoil:
    return lambda pair: replace(pair, x=frozen_array(pair.x + value))


def with_cov(cov: np.ndarray) -> Spoil:
    return lambda pair: replace(pair, cov=frozen_array(cov))


REFUSED: dict[str, tuple[Spoil, str]] = {
    "an angle that is no number": (with_q(np.nan), "not finite"),
    "a place that is no number": (with_x(np.nan), "not finite"),
    "an infinite place": (with_x(np.inf), "not finite"),
    "a covariance that is no number": (with_cov(np.full((3, 3), np.nan)), "not finite"),
    "a place in millimetres": (with_x(5e3), "positions are in metres"),
    "an absurd angle": (with_q(1e300), "angles are in radians"),
    "a huge covariance": (with_cov(1e300 * np.eye(3)), "m wrong"),
    "a negative variance": (with_cov(np.diag([1e-6, -1e-6, 1e-6])), "is no covariance"),
    "a correlation above one": (with_cov(1e-6 * np.array([[1, 2, 0], [2, 1, 0], [0, 0, 1]])), "is no covariance"),
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.draw(0, 2 * TAUGHT)


@pytest.mark.parametrize("kind", REFUSED)
@pytest.mark.parametrize("before", [0, 5])
def test_impossible_pair_is_refused_and_changes_nothing(scene, kind, before) -> None:
    learning, (spoil, why) = new_learning(), REFUSED[kind]
    teach(learning, scene.pairs[:before])
    was = learning.snapshot
    with pytest.raises(RequestError, match=why):
        learning.learn(spoil(scene.pairs[before]), 0.0)
    assert learning.snapshot is was
    assert learning.counters.last_seq == before


@pytest.fixture(scope="module")
def clean_error_m(scene: Scene) -> float:
    """Return the error of a learner that met no wild pair."""
    learning = new_learning()
    teach(learning, scene.pairs, every=NOW_AND_THEN)
    return scene.error_m(learning)


@pytest.mark.parametrize(
    ("first", "spoil"),
    [
        (0, with_x(10.0)),
        (TAUGHT, with_q(1e5)),
        *(
            pytest.param(first, spoil, marks=pytest.mark.soak)
            for first, spoil in (
                (0, with_x(-900.0)),
                (0, with_q(1e5)),
                (0, with_cov(1e4 * np.eye(3))),
                (TAUGHT, with_cov(1e4 * np.eye(3))),
                (TAUGHT, with_x(10.0)),
                (TAUGHT, with_x(-900.0)),
            )
        ),
    ],
)
def test_learner_recovers_from_plausible_wild_pairs(scene, clean_error_m, spoil, first) -> None:
    learning, pairs = new_learning(), list(scene.pairs)
    pairs[first : first + 2] = map(spoil, pairs[first : first + 2])
    teach(learning, pairs, every=NOW_AND_THEN)
    prediction = learning.snapshot.predict(scene.q)
    assert np.isfinite(prediction.sigma).all()
    assert scene.error_m(learning) < 4.0 * clean_error_m


def test_query_without_finite_answer_is_refused(scene, monkeypatch) -> None:
    learning = new_learning()
    snapshot = learning.snapshot
    monkeypatch.setattr(type(snapshot.model), "predict", lambda _, q: np.full((len(q), 3), np.nan))
    with pytest.raises(RequestError, match="no finite answer"):
        snapshot.predict(scene.q[:2])


@pytest.mark.parametrize("name", ["net_prior", "net_nlms", "q", "x"])
def test_non_finite_state_is_not_restored(scene, name) -> None:
    learning = new_learning()
    teach(learning, scene.pairs[:5])
    state = learning.state()
    invalid_array = LearningState(state.header, {**state.arrays, name: state.arrays[name] * np.nan})
    with pytest.raises(StateError, match=f"{name} is not finite"):
        OnlineLearner(nominal_model(), LearnerConfig(), DirectSolver()).restore(invalid_array)
