from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from planted_chains import bases_for
from rough_arms import ROUGH, Arm, rough_arm

from kbmaps import (
    DegenerateDataError,
    Estimate,
    KernelLearner,
    Ladder,
    Model,
    ModelFormatError,
    RigidLearner,
    Rung,
    SettingError,
    TensorLearner,
)

KINDS = "RRR"
LIMIT = np.full(3, np.radians(90.0))


class Scripted:
    """A model with scripted answers."""

    joints = 3

    def __init__(
        self,
        says: Callable[[np.ndarray], np.ndarray],
        breaks_at: float = math.inf,
        mends_at: float = math.inf,
        error: Exception | None = None,
    ) -> None:
        self.pairs = 0
        self.says, self.breaks_at, self.mends_at = says, breaks_at, mends_at
        self.error = error or FloatingPointError("overflow")
        self.seen: list[np.ndarray] = []

    def learn(self, q, x, sigma=None):
        self.pairs += len(np.atleast_2d(q))
        self.seen.extend(np.atleast_2d(q))
        if self.breaks_at <= self.pairs < self.mends_at:
            raise self.error

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
    """Return positions of an arm that no rigid chain fits."""
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


def test_a_model_that_broke_is_back_when_it_can_digest_the_pairs(arm):
    other = Scripted(lambda q: bent(arm, q), breaks_at=20, mends_at=40)
    held = ladder(arm, other)
    rng = np.random.default_rng(11)
    q, _ = arm.pairs(rng, 120)
    x = bent(arm, q) + 0.002 * rng.normal(size=(120, 3))
    held.learn(q[:30], x[:30])
    assert held.failures == {"other": "overflow"}
    held.learn(q[30:], x[30:])
    assert (held.answering, held.failures) == ("other", {})
    np.testing.assert_array_equal(other.seen, q)


def test_a_model_that_comes_back_with_nonsense_stays_out(arm):
    other = Scripted(lambda q: np.full((len(q), 3), 0.0 if other.pairs < 20 else math.nan), breaks_at=20, mends_at=21)
    held = ladder(arm, other)
    held.learn(*arm.pairs(np.random.default_rng(12), 60, 0.005))
    assert held.answering == "rigid"
    assert "not finite" in held.failures["other"]


def test_a_model_that_came_back_is_compared_by_what_it_predicts_since(arm):
    """The model was right before, and is wrong since."""
    other = Scripted(lambda q: bent(arm, q) if other.pairs < 60 else np.zeros((len(q), 3)), breaks_at=40, mends_at=60)
    held, failed = ladder(arm, other), False
    for q in arm.pairs(np.random.default_rng(13), 120)[0]:
        held.learn(q, bent(arm, q[None])[0])
        failed = failed or "other" in held.failures
    assert failed
    assert held.failures == {}
    assert held.answering == "rigid"
    assert held.errors()["other"] > 0.1


def test_a_model_without_prior_joins_in_when_it_has_pairs_enough(arm):
    held = ladder(arm, TensorLearner(bases_for(KINDS)))
    q, _ = arm.pairs(np.random.default_rng(14), 120)
    held.learn(q[:10], bent(arm, q[:10]))
    assert "needs" in held.failures["other"]
    assert "other" not in held.errors()
    held.learn(q[10:], bent(arm, q[10:]))
    assert held.failures == {}
    assert "other" in held.errors()


def test_who_is_not_ready_leaves_the_answer_to_the_next(arm):
    rigid = RigidLearner(arm.nominal, ROUGH)
    held = Ladder({"tensor": Rung(TensorLearner(bases_for(KINDS))), "rigid": Rung(rigid)})
    q, _ = arm.pairs(np.random.default_rng(15), 5)
    assert held.answering == "rigid"
    np.testing.assert_array_equal(held.predict(q), rigid.predict(q))


def test_a_ladder_of_which_nobody_is_ready_says_so(arm):
    held = Ladder({"tensor": Rung(TensorLearner(bases_for(KINDS)))})
    held.learn(*arm.pairs(np.random.default_rng(16), 5))
    with pytest.raises(DegenerateDataError, match="needs"):
        held.predict(np.zeros(3))


def test_a_mistake_in_a_model_s_code_is_seen(arm):
    held = ladder(arm, Scripted(arm.real.positions, breaks_at=20, error=ValueError("shapes do not match")))
    with pytest.raises(ValueError, match="shapes do not match"):
        held.learn(*arm.pairs(np.random.default_rng(17), 60))


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
    held.learn(*arm.pairs(rng, 20, 0.005))
    copy = Ladder.from_bytes(held.to_bytes())
    more = arm.pairs(rng, 8, 0.005)
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
