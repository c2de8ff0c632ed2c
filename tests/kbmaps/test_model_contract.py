"""Contract of `kbmaps.Model`, checked for every implementation."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable

import numpy as np
import pytest
from planted_chains import bases_for
from rough_arms import ROUGH, Arm, rough_arm

from kbmaps import (
    DegenerateDataError,
    InverseKinematics,
    KernelLearner,
    Memory,
    Model,
    ModelFormatError,
    NonFiniteError,
    NotNumbersError,
    RecursiveRigidLearner,
    ResidualLearner,
    RigidLearner,
    SettingError,
    ShapeError,
    TensorLearner,
)

KINDS = "RPR"
MODELS: dict[str, Callable[[Arm], Model]] = {
    "kernel": lambda arm: KernelLearner(bases_for(KINDS), arm.nominal),
    "kernel, from nothing": lambda arm: KernelLearner(bases_for(KINDS)),
    "kernel, exact": lambda arm: KernelLearner(bases_for(KINDS), arm.nominal, precision=None),
    "kernel, with a window": lambda arm: KernelLearner(bases_for(KINDS), arm.nominal, memory=Memory(8, 0.95)),
    "rigid": lambda arm: RigidLearner(arm.nominal, ROUGH),
    "recursive rigid": lambda arm: RecursiveRigidLearner(arm.nominal, ROUGH),
    "recursive rigid, with a folded window": lambda arm: RecursiveRigidLearner(arm.nominal, ROUGH, window=16),
    "residual": lambda arm: ResidualLearner(arm.nominal, ROUGH),
    "residual, after a tool change": lambda arm: ResidualLearner(
        arm.nominal, ROUGH, bent_learner(arm).model.with_other_tool(0.1)
    ),
    "residual, of a known chain": lambda arm: ResidualLearner(arm.nominal, ROUGH, bent_learner(arm).rigid.belief),
    "tensor": lambda arm: TensorLearner.around(arm.nominal, bases_for(KINDS)),
    "tensor, from nothing": lambda arm: TensorLearner(bases_for(KINDS)),
}
# Models that report support by the law of `Estimate`.
LAWFUL = [name for name in MODELS if not name.startswith("kernel")]
# Models whose state needs more pairs than a lesson of 12 to be complete.
LONG = {
    "recursive rigid, with a folded window": 40,
    "residual": 150,
    "residual, after a tool change": 12,
    "tensor, from nothing": 40,
}


def bent_pairs(arm: Arm, rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of the arm with eccentric encoders, and errors without a modelled cause."""
    q = arm.pairs(rng, n)[0]
    x = arm.real.positions(q + 0.03 * np.sin(q + 1.0)) + 0.02 * np.sin(2.0 * q)
    return q, x + 0.001 * rng.normal(size=(n, 3))


@functools.cache
def bent_learner(arm: Arm) -> ResidualLearner:
    learner = ResidualLearner(arm.nominal, ROUGH)
    learner.learn(*bent_pairs(arm, np.random.default_rng(6), 150))
    return learner


ARM = rough_arm(np.random.default_rng(1), KINDS)


def freshly_taught(name: str) -> Model:
    rng = np.random.default_rng(2)
    model = MODELS[name](ARM)
    model.learn(*(bent_pairs(ARM, rng, LONG[name]) if name in LONG else ARM.pairs(rng, 12, 0.01)))
    return model


taught_once = functools.cache(freshly_taught)
# For the test that begins with a model that has not been asked yet, then for the one that ends by teaching it more.
taught_apart = functools.cache(freshly_taught)


@pytest.fixture
def arm() -> Arm:
    return ARM


@pytest.fixture(params=MODELS)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def model(name: str, arm: Arm) -> Model:
    return MODELS[name](arm)


@pytest.fixture
def taught(name: str) -> Model:
    """Return a trained model that all tests share: none of them changes it."""
    return taught_once(name)


@pytest.fixture
def q(arm: Arm) -> np.ndarray:
    return arm.pairs(np.random.default_rng(3), 7)[0]


def test_pairs_are_counted_singly_and_in_batches(model, arm):
    q, x = arm.pairs(np.random.default_rng(4), 6, 0.01)
    assert (model.joints, model.pairs) == (3, 0)
    model.learn(q[0], x[0])
    model.learn(q[1:], x[1:], 0.01)
    assert model.pairs == 6


def test_batch_predictions_equal_single_predictions(taught, q):
    batch = taught.predict(q)
    assert batch.shape == (7, 3)
    for k in range(7):
        np.testing.assert_allclose(taught.predict(q[k]), batch[k], rtol=0, atol=1e-12)


def test_jacobian_is_derivative_of_predictions(taught, q):
    step = 1e-4
    jacobian = taught.jacobian(q)
    assert jacobian.shape == (7, 3, 3)
    for k, move in enumerate(step * np.eye(3)):
        x = [taught.predict(q + way * move) for way in (-2, -1, 1, 2)]
        slope = (x[0] - 8.0 * x[1] + 8.0 * x[2] - x[3]) / (12.0 * step)
        np.testing.assert_allclose(jacobian[:, :, k], slope, rtol=0, atol=1e-9)
    np.testing.assert_allclose(taught.jacobian(q[2]), jacobian[2], rtol=0, atol=1e-12)


def test_inverse_kinematics_solves_on_it(taught, q):
    solution = InverseKinematics(taught, -np.abs(q).max(axis=0), np.abs(q).max(axis=0)).solve(taught.predict(q[0]))
    assert solution.converged


def test_single_estimate_equals_its_row_of_a_batch(taught, q):
    one, batch = taught.estimate(q[2]), taught.estimate(q)
    assert (one.x.shape, one.sigma.shape, one.in_support.shape) == ((3,), (3,), ())
    np.testing.assert_allclose(one.x, batch.x[2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.sigma, batch.sigma[2], rtol=1e-6, atol=1e-12)
    assert one.in_support == batch.in_support[2]


@pytest.mark.parametrize("name", LAWFUL)
def test_all_learnt_pairs_are_in_support(model, arm):
    q, x = arm.pairs(np.random.default_rng(8), 40, 0.001)
    model.learn(q, x)
    assert model.estimate(q).in_support.all()


@pytest.mark.parametrize("name", LAWFUL)
def test_poses_far_from_data_are_not_in_support(model, arm):
    rng = np.random.default_rng(9)
    model.learn(*arm.pairs(rng, 40, 0.001, reach_deg=10.0))
    q = arm.pairs(rng, 200)[0]
    far = np.abs(q)[:, [0, 2]].max(axis=1) > np.radians(50.0)
    assert model.estimate(q[far]).in_support.mean() < 0.05


def test_chain_learners_agree_on_share_in_support():
    rng = np.random.default_rng(10)
    arm = rough_arm(rng)
    q, x = arm.pairs(rng, 100, 0.002, reach_deg=30.0)
    elsewhere = arm.pairs(rng, 1000)[0]
    shares = []
    for learner in (RigidLearner, RecursiveRigidLearner, ResidualLearner):
        model: Model = learner(arm.nominal, ROUGH)
        model.learn(q, x)
        shares.append(model.estimate(elsewhere).in_support.mean())
    assert 0.02 < min(shares) <= max(shares) < min(shares) + 0.03 < 0.2


def test_estimate_matches_prediction_with_sigma_and_support_flags(taught, q):
    estimate = taught.estimate(q)
    np.testing.assert_allclose(estimate.x, taught.predict(q), rtol=0, atol=1e-12)
    assert estimate.sigma.shape == (7, 3)
    assert (estimate.sigma >= 0.0).all()
    assert estimate.in_support.shape == (7,)
    assert estimate.in_support.dtype == np.bool_


def test_predicting_changes_nothing(name, q):
    taught = taught_apart(name)
    before = taught.to_bytes()
    first = taught.predict(q)
    taught.estimate(q)
    np.testing.assert_array_equal(taught.predict(q), first)
    assert taught.to_bytes() == before


def test_an_empty_batch_is_no_trouble(taught):
    before = taught.pairs
    assert taught.predict(np.empty((0, 3))).shape == (0, 3)
    estimate = taught.estimate(np.empty((0, 3)))
    assert (estimate.x.shape, estimate.sigma.shape, estimate.in_support.shape) == ((0, 3), (0, 3), (0,))
    taught.learn(np.empty((0, 3)), np.empty((0, 3)))
    taught.learn(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert taught.pairs == before


def test_nothing_learnt_changes_nothing(taught, q):
    before = taught.predict(q)
    taught.learn(np.empty((0, 3)), np.empty((0, 3)))
    np.testing.assert_array_equal(taught.predict(q), before)


def test_no_pairs_are_no_trouble_before_the_first(model):
    model.learn(np.empty((0, 3)), np.empty((0, 3)))
    assert model.pairs == 0


def test_before_the_first_pair_nothing_is_in_support(model, q):
    """A model that has to wait for more pairs says so instead."""
    with contextlib.suppress(DegenerateDataError):
        assert not model.estimate(q).in_support.any()


@pytest.mark.parametrize("name", ["residual", "residual, after a tool change"])
def test_the_lessons_of_a_bent_arm_leave_deviations(taught):
    assert "one joint" in taught.model.weights


def test_the_lesson_of_a_short_window_folds_it(arm):
    learner = MODELS["recursive rigid, with a folded window"](arm)
    learner.learn(*bent_pairs(arm, np.random.default_rng(2), 40))
    assert learner.kept < learner.pairs


def test_restored_model_estimates_and_learns_bit_for_bit(name, arm, q):
    taught = taught_apart(name)
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
        (NotNumbersError, "a", np.zeros(3), None),
        (NotNumbersError, [[0.0, 0.0, 0.0], [0.0]], np.zeros((2, 3)), None),
        (NotNumbersError, np.zeros(3), np.zeros(3), "a"),
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


def test_non_bytes_input_is_refused(model):
    with pytest.raises(ModelFormatError, match="bytes, as to_bytes gives them"):
        type(model).from_bytes("x")


def test_wrong_configurations_are_refused(taught):
    with pytest.raises(ShapeError):
        taught.predict(np.zeros(2))
    with pytest.raises(NonFiniteError):
        taught.estimate([[math.nan, 0.0, 0.0]])
