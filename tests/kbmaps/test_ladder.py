from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from planted_chains import bases_for
from rough_arms import ROUGH, Arm, rough_arm

from kbmaps import (
    Estimate,
    KernelLearner,
    Ladder,
    Model,
    ModelFormatError,
    RigidLearner,
    Rung,
    SettingError,
)

KINDS = "RRR"
LIMIT = np.full(3, np.radians(90.0))


class Scripted:
    """A model that says what it is told to."""

    joints = 3

    def __init__(self, says: Callable[[np.ndarray], np.ndarray], breaks_at: float = math.inf) -> None:
        self.pairs = 0
        self.says, self.breaks_at = says, breaks_at

    def learn(self, q, x, sigma=None):
        self.pairs += len(np.atleast_2d(q))
        if self.pairs >= self.breaks_at:
            raise FloatingPointError("overflow")

    def predict(self, q):
        return self.says(np.atleast_2d(q)) if np.ndim(q) == 2 else self.says(np.atleast_2d(q))[0]

    def estimate(self, q):
        x = self.predict(q)
        return Estimate(x, np.full(x.shape, 0.001), np.abs(q).max(axis=1) < 0.5)

    def to_bytes(self):
        return b""

    @classmethod
    def from_bytes(cls, data):
        raise ModelFormatError("it is only scripted")


@pytest.fixture
def arm() -> Arm:
    return rough_arm(np.random.default_rng(1), KINDS)


def ladder(arm: Arm, other: Model, **settings) -> Ladder:
    return Ladder({"rigid": Rung(RigidLearner(arm.nominal, ROUGH)), "other": Rung(other, **settings)})


def test_the_model_that_predicts_best_answers(arm):
    held = ladder(arm, Scripted(lambda q: np.zeros((len(q), 3))))
    held.learn(*arm.pairs(np.random.default_rng(2), 60, 0.005))
    assert held.answering == "rigid"


def bent(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Positions of an arm that no rigid chain follows."""
    return arm.real.positions(q) + 0.05 * np.sin(2.0 * q)


def test_a_less_trusted_model_that_is_better_answers(arm):
    held = ladder(arm, Scripted(lambda q: bent(arm, q)))
    q, x = arm.pairs(np.random.default_rng(3), 60, 0.002)
    held.learn(q, x - arm.real.positions(q) + bent(arm, q))
    assert held.answering == "other"


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e300])
def test_a_model_that_predicts_nonsense_spoils_nothing(arm, value):
    alone = RigidLearner(arm.nominal, ROUGH)
    held = ladder(arm, Scripted(lambda q: np.full((len(q), 3), value)))
    q, x = arm.pairs(np.random.default_rng(4), 40, 0.005)
    alone.learn(q, x)
    held.learn(q, x)
    np.testing.assert_array_equal(held.predict(q), alone.predict(q))


def test_a_model_that_breaks_is_out_and_says_why(arm):
    held = ladder(arm, Scripted(arm.real.positions, breaks_at=20))
    held.learn(*arm.pairs(np.random.default_rng(5), 60, 0.005))
    assert (held.answering, held.failures) == ("rigid", {"other": "overflow"})


def test_where_it_had_no_data_a_model_that_may_not_extrapolate_does_not_answer(arm):
    held = ladder(arm, Scripted(lambda q: bent(arm, q)), extrapolates=False)
    q, x = arm.pairs(np.random.default_rng(6), 60, 0.002)
    held.learn(q, x - arm.real.positions(q) + bent(arm, q))
    inside, outside = np.full((1, 3), 0.1), np.full((1, 3), 1.2)
    np.testing.assert_allclose(held.predict(inside), bent(arm, inside))
    np.testing.assert_array_equal(held.predict(outside), held.models["rigid"].predict(outside))


def test_who_answers_has_learnt_all_pairs_that_came_at_once(arm):
    held, alone = ladder(arm, Scripted(lambda q: np.zeros((len(q), 3)))), RigidLearner(arm.nominal, ROUGH)
    q, x = arm.pairs(np.random.default_rng(7), 100, 0.005)
    held.learn(q, x, 0.005)
    alone.learn(q, x, 0.005)
    np.testing.assert_allclose(held.predict(q), alone.predict(q), rtol=0, atol=1e-9)


def test_pairs_one_by_one_are_learnt_at_each_models_own_pace(arm):
    eager, lazy = Scripted(lambda q: np.zeros((len(q), 3))), Scripted(lambda q: np.zeros((len(q), 3)))
    held = Ladder({"eager": Rung(eager, growth=0.0), "lazy": Rung(lazy, growth=1.0)})
    for q, x in zip(*arm.pairs(np.random.default_rng(8), 50), strict=True):
        held.learn(q, x)
    assert (eager.pairs, lazy.pairs) == (50, 32)


def test_the_usual_ladder_survives_as_bytes(arm):
    held = Ladder.around(arm.nominal, ROUGH, -LIMIT, LIMIT)
    rng = np.random.default_rng(9)
    held.learn(*arm.pairs(rng, 50, 0.005))
    copy = Ladder.from_bytes(held.to_bytes())
    more = arm.pairs(rng, 30, 0.005)
    for one in (held, copy):
        one.learn(*more)
    np.testing.assert_array_equal(copy.predict(more[0]), held.predict(more[0]))
    assert (copy.answering, copy.errors()) == (held.answering, held.errors())


def test_a_stored_ladder_with_an_unknown_model_is_refused(arm):
    held = ladder(arm, Scripted(lambda q: np.zeros((len(q), 3))))
    with pytest.raises(ModelFormatError, match="Scripted"):
        Ladder.from_bytes(held.to_bytes())


@pytest.mark.parametrize("damage", [b"", b"KBPACK\r\n", b"\0" * 100])
def test_damaged_bytes_are_refused(damage):
    with pytest.raises(ModelFormatError):
        Ladder.from_bytes(damage)


def test_impossible_ladders_are_refused(arm):
    rigid = RigidLearner(arm.nominal, ROUGH)
    taught = RigidLearner(arm.nominal, ROUGH)
    taught.learn(*arm.pairs(np.random.default_rng(10), 5))
    with pytest.raises(SettingError, match="none"):
        Ladder({})
    with pytest.raises(SettingError, match="may extrapolate"):
        Ladder({"rigid": Rung(rigid, extrapolates=False)})
    with pytest.raises(SettingError, match="number of joints"):
        Ladder({"rigid": Rung(rigid), "kernel": Rung(KernelLearner(bases_for("RR")))})
    with pytest.raises(SettingError, match="must not have learnt"):
        Ladder({"rigid": Rung(taught)})
    with pytest.raises(SettingError, match="growth"):
        Rung(rigid, growth=-1.0)
