"""What `kbmaps.Model` promises, held for every implementation."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from planted_chains import bases_for
from rough_arms import ROUGH, Arm, rough_arm

from kbmaps import (
    KernelLearner,
    Ladder,
    Memory,
    Model,
    ModelFormatError,
    NonFiniteError,
    RecursiveRigidLearner,
    ResidualLearner,
    RigidLearner,
    SettingError,
    ShapeError,
    StructuredLearner,
    TensorLearner,
    ToolLayer,
)

KINDS = "RPR"
MODELS: dict[str, Callable[[Arm], Model]] = {
    "kernel": lambda arm: KernelLearner(bases_for(KINDS), arm.nominal),
    "kernel, from nothing": lambda arm: KernelLearner(bases_for(KINDS)),
    "kernel, exact": lambda arm: KernelLearner(bases_for(KINDS), arm.nominal, precision=None),
    "kernel, with a window": lambda arm: KernelLearner(bases_for(KINDS), arm.nominal, memory=Memory(8, 0.95)),
    "structured": lambda arm: StructuredLearner(arm.nominal, ROUGH, bases_for(KINDS)),
    "tool layer": lambda arm: ToolLayer(arm.nominal),
    "tool layer on a map": lambda arm: ToolLayer(arm.nominal.to_kbmap(bases_for(KINDS), orientation=True)),
    "rigid": lambda arm: RigidLearner(arm.nominal, ROUGH),
    "recursive rigid": lambda arm: RecursiveRigidLearner(arm.nominal, ROUGH),
    "residual": lambda arm: ResidualLearner(arm.nominal, ROUGH),
    "ladder": lambda arm: Ladder.around(arm.nominal, ROUGH, np.full(3, -1.4), np.full(3, 1.4)),
    "tensor": lambda arm: TensorLearner.around(arm.nominal, bases_for(KINDS)),
}


@pytest.fixture
def arm() -> Arm:
    return rough_arm(np.random.default_rng(1), KINDS)


@pytest.fixture(params=MODELS)
def model(request: pytest.FixtureRequest, arm: Arm) -> Model:
    return MODELS[request.param](arm)


@pytest.fixture
def taught(model: Model, arm: Arm) -> Model:
    model.learn(*arm.pairs(np.random.default_rng(2), 12, 0.01))
    return model


@pytest.fixture
def q(arm: Arm) -> np.ndarray:
    return arm.pairs(np.random.default_rng(3), 7)[0]


def test_pairs_are_counted_one_by_one_or_in_one_go(model, arm):
    q, x = arm.pairs(np.random.default_rng(4), 6, 0.01)
    assert (model.joints, model.pairs) == (3, 0)
    model.learn(q[0], x[0])
    model.learn(q[1:], x[1:], 0.01)
    assert model.pairs == 6


def test_a_row_of_a_batch_is_what_is_predicted_for_it_alone(taught, q):
    batch = taught.predict(q)
    assert batch.shape == (7, 3)
    for k in range(7):
        np.testing.assert_allclose(taught.predict(q[k]), batch[k], rtol=0, atol=1e-12)


def test_an_estimate_is_of_what_is_predicted_and_says_how_sure_it_is(taught, q):
    estimate = taught.estimate(q)
    np.testing.assert_allclose(estimate.x, taught.predict(q), rtol=0, atol=1e-12)
    assert estimate.sigma.shape == (7, 3)
    assert (estimate.sigma >= 0.0).all()
    assert estimate.in_support.shape == (7,)
    assert estimate.in_support.dtype == np.bool_


def test_predicting_changes_nothing(taught, q):
    before = taught.to_bytes()
    first = taught.predict(q)
    taught.estimate(q)
    np.testing.assert_array_equal(taught.predict(q), first)
    assert taught.to_bytes() == before


def test_an_empty_batch_is_no_trouble(taught):
    assert taught.predict(np.empty((0, 3))).shape == (0, 3)
    assert taught.estimate(np.empty((0, 3))).sigma.shape == (0, 3)
    taught.learn(np.empty((0, 3)), np.empty((0, 3)))
    assert taught.pairs == 12


def test_before_the_first_pair_nothing_is_in_support(model, q):
    assert not model.estimate(q).in_support.any()


def test_bytes_give_the_same_estimate_to_the_last_bit_and_learn_on(taught, arm, q):
    again = type(taught).from_bytes(taught.to_bytes())
    more = arm.pairs(np.random.default_rng(5), 3, 0.01)
    for _ in range(2):
        before, after = taught.estimate(q), again.estimate(q)
        np.testing.assert_array_equal(before.x, after.x)
        np.testing.assert_array_equal(before.sigma, after.sigma)
        np.testing.assert_array_equal(before.in_support, after.in_support)
        for one in (taught, again):
            one.learn(*more)


@pytest.mark.parametrize("spoil", [lambda data: data[:-1], lambda data: data[:40] + b"?" + data[41:], lambda _: b""])
def test_damaged_bytes_are_refused(taught, spoil):
    with pytest.raises(ModelFormatError):
        type(taught).from_bytes(spoil(taught.to_bytes()))


@pytest.mark.parametrize(
    ("error", "q", "x", "sigma"),
    [
        (ShapeError, np.zeros(4), np.zeros(3), None),
        (ShapeError, np.zeros((2, 3)), np.zeros((3, 3)), None),
        (ShapeError, np.zeros((2, 3)), np.zeros((2, 3)), np.ones(3)),
        (NonFiniteError, np.zeros(3), [0.0, math.nan, 0.0], None),
        (NonFiniteError, [math.inf, 0.0, 0.0], np.zeros(3), None),
        (SettingError, np.zeros(3), np.zeros(3), 0.0),
    ],
)
def test_refused_pairs_change_nothing(taught, error, q, x, sigma):
    before = taught.to_bytes()
    with pytest.raises(error):
        taught.learn(q, x, sigma)
    assert taught.to_bytes() == before


def test_wrong_configurations_are_refused(taught):
    with pytest.raises(ShapeError):
        taught.predict(np.zeros(2))
    with pytest.raises(NonFiniteError):
        taught.estimate([[math.nan, 0.0, 0.0]])
