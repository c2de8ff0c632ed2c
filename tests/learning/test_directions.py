"""Weights of the three directions of a measured position in what the learner solves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from guided_arm import JOINTS, built_chain, make_pair, near, new_learning, nominal_model, teach

from bodyschema.interfaces.records import FloatArray, frozen_array
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver, Task, fitted_belief, fitted_residual
from kbmaps import ChainTolerances, ResidualLearner, RigidChain, RigidLearner

NOMINAL = nominal_model()
BELIEF = NOMINAL.belief(NOMINAL.chain, ChainTolerances(axes=0.05, points=0.015, zeros=0.05, tool=0.03))
ACROSS_M, PAIRS, ARMS = 1e-4, 120, 12
CAMERA = np.array([0.2, -0.3, -0.5])
ONE_CAMERA, TWO_CAMERAS = 10.0, 3.0


def stated(x: FloatArray, depth: float) -> FloatArray:
    """Return covariances (n, 3, 3) [m²] of a camera whose depth is so many times less sure than what is across."""
    sight = (x - CAMERA) / np.linalg.norm(x - CAMERA, axis=1)[:, None]
    return ACROSS_M**2 * (np.eye(3) + (depth**2 - 1.0) * sight[:, :, None] * sight[:, None, :])


class Seen:
    """Pairs of one arm, with noise drawn from their covariances, and poses to test with."""

    def __init__(self, seed: int, depth: float, reading_rad: float = 0.0) -> None:
        rng = np.random.default_rng([5, seed])
        self.arm: RigidChain = built_chain(rng)
        self.q = rng.uniform(-1.0, 1.0, (PAIRS, JOINTS))
        true = self.arm.positions(self.q)
        self.cov = stated(true, depth)
        self.x = true + np.matvec(np.linalg.cholesky(self.cov), rng.normal(size=true.shape))
        self.test = near(rng, self.q)
        self.q = self.q + reading_rad * rng.normal(size=self.q.shape)

    def error_m(self, cov: FloatArray | None) -> float:
        found = fitted_belief(BELIEF, self.q, self.x, cov)
        return float(np.sqrt(np.square(found.predict(self.test) - self.arm.positions(self.test)).sum(axis=1).mean()))


def gain(depth: float, stated_depth: float, reading_rad: float = 0.0, size: float = 1.0) -> float:
    """Return how many times smaller the error is than with all directions alike, the geometric mean of the arms."""
    ratios = list[float]()
    for seed in range(ARMS):
        seen = Seen(seed, depth, reading_rad)
        cov = size**2 * stated(seen.arm.positions(seen.q), stated_depth)
        ratios.append(seen.error_m(None) / seen.error_m(cov))
    return float(np.exp(np.log(ratios).mean()))


def expected_m(seen: Seen, weighed_by: FloatArray) -> float:
    """Return the expected RMS error [m] of least squares with these covariances (n, 3, 3) [m²], and BELIEF as prior."""
    parameters, free = BELIEF.parameters, BELIEF.root.any(axis=1)
    built = fitted_belief(BELIEF, seen.q, seen.arm.positions(seen.q)).mean
    jacobian, there = (parameters.linearised(built, q)[1] for q in (seen.q, seen.test))
    J, weights = (jacobian @ BELIEF.root)[:, :, free], np.linalg.inv(weighed_by)
    G = np.linalg.inv(np.eye(J.shape[2]) + np.einsum("nik,nij,njl->kl", J, weights, J))
    noise = weights @ seen.cov @ weights
    spread = G @ (np.eye(J.shape[2]) + np.einsum("nik,nij,njl->kl", J, noise, J)) @ G
    T = (there @ BELIEF.root)[:, :, free]
    return float(np.sqrt(np.einsum("nik,kl,nil->n", T, spread, T).mean()))


@pytest.mark.parametrize("depth", [ONE_CAMERA, TWO_CAMERAS])
def test_surer_directions_count_as_theory_has_it(depth: float) -> None:
    theory = list[float]()
    for seed in range(ARMS):
        seen = Seen(seed, depth)
        alike = np.eye(3) * np.trace(seen.cov, axis1=1, axis2=2).mean() / 3.0
        theory.append(expected_m(seen, np.broadcast_to(alike, seen.cov.shape)) / expected_m(seen, seen.cov))
    assert gain(depth, depth) > 0.93 * np.exp(np.log(theory).mean()) > 1.1


@pytest.mark.parametrize("stated_depth", [ONE_CAMERA / 3.0, 3.0 * ONE_CAMERA])
def test_a_wrong_stated_depth_costs_little(stated_depth: float) -> None:
    assert gain(ONE_CAMERA, stated_depth) > 0.95 * gain(ONE_CAMERA, ONE_CAMERA)


@pytest.mark.parametrize("size", [0.5, 2.0])
def test_the_stated_size_is_of_no_account(size: float) -> None:
    assert gain(ONE_CAMERA, ONE_CAMERA, size=size) == pytest.approx(gain(ONE_CAMERA, ONE_CAMERA), rel=0.02)


@pytest.mark.parametrize("stated_depth", [3.0, 30.0])
def test_a_shape_that_does_not_hold_costs_nothing(stated_depth: float) -> None:
    """The camera's noise is the same in all directions, and small beside that of the joints."""
    assert gain(1.0, stated_depth, reading_rad=0.002) > 0.98


def test_predicted_sigmas_cover_the_truth() -> None:
    inside = list[float]()
    for seed in range(ARMS):
        seen = Seen(seed, ONE_CAMERA)
        x, variance = fitted_belief(BELIEF, seen.q, seen.x, seen.cov).predict_with_variance(seen.test)
        off = np.abs(x - seen.arm.positions(seen.test))
        inside.append(float((off < 2.0 * np.sqrt(variance)).mean()))
    assert np.mean(inside) > 0.88


def test_outliers_of_the_depth_cost_no_accuracy() -> None:
    """One in five is 50 mm too far from the camera, as where a small tag is seen tilted the wrong way."""
    ratios = list[float]()
    for seed in range(ARMS):
        seen = Seen(seed, ONE_CAMERA)
        good = seen.error_m(seen.cov)
        sight = (seen.x - CAMERA) / np.linalg.norm(seen.x - CAMERA, axis=1)[:, None]
        seen.x[::5] += 0.05 * sight[::5]
        ratios.append(seen.error_m(seen.cov) / good)
    assert np.exp(np.log(ratios).mean()) < 1.3


@pytest.mark.parametrize("missing", [0.0, 1.0])
def test_isotropic_covariances_change_nothing(missing: float) -> None:
    seen = Seen(0, ONE_CAMERA)
    cov = np.broadcast_to(np.eye(3) * 4e-6, (PAIRS, 3, 3)).copy()
    cov[: int(missing * PAIRS)] = np.nan
    np.testing.assert_array_equal(
        fitted_belief(BELIEF, seen.q, seen.x, cov).mean, fitted_belief(BELIEF, seen.q, seen.x).mean
    )


def test_pairs_without_covariance_are_learnt_with_the_others() -> None:
    seen = Seen(1, ONE_CAMERA)
    cov = seen.cov.copy()
    cov[::3] = np.nan
    assert seen.error_m(cov) < 0.7 * seen.error_m(None)


def test_gross_outlier_in_uncertain_depth_is_rejected() -> None:
    seen = Seen(2, ONE_CAMERA)
    good = seen.error_m(seen.cov)
    seen.x[7] += 50.0 * ACROSS_M * np.linalg.svd(seen.cov[7])[0][:, 2]
    assert seen.error_m(seen.cov) < 1.3 * good


def test_the_chain_with_residual_weighs_them_too() -> None:
    seen = Seen(3, ONE_CAMERA)
    off = list[float]()
    for cov in (None, seen.cov):
        found = fitted_residual(BELIEF, seen.q, seen.x, cov)
        assert found is not None
        off.append(float(np.square(found.predict(seen.test) - seen.arm.positions(seen.test)).mean()))
    assert off[1] < off[0] / 4.0


def test_solver_weighs_pairs_by_their_covariances() -> None:
    seen, solver = Seen(4, ONE_CAMERA), DirectSolver()
    solver.start(Task(1, NOMINAL.prior, BELIEF))
    for part in (slice(0, 50), slice(50, None)):
        solver.learn(seen.q[part], seen.x[part], seen.cov[part])
    solved = [each for each in solver.solutions() if each.wide is not None][-1]
    assert solved.wide is not None
    np.testing.assert_allclose(solved.wide.mean, fitted_belief(BELIEF, seen.q, seen.x, seen.cov).mean)


@pytest.fixture(scope="module")
def taught() -> tuple[Seen, OnlineLearner]:
    """Return pairs that a camera saw, and a learner that waited for its pose before it learnt them."""
    seen, learning = Seen(6, ONE_CAMERA), new_learning(nominal_model(pose_known=False))
    pairs = [make_pair(k + 1, seen.q[k], seen.x[k]) for k in range(PAIRS)]
    teach(learning, [replace(pair, cov=frozen_array(cov)) for pair, cov in zip(pairs, seen.cov, strict=True)], every=60)
    return seen, learning


def test_the_online_learner_weighs_them(taught) -> None:
    seen, learning = taught
    assert learning.belief is not None
    off = learning.belief.predict(seen.test) - seen.arm.positions(seen.test)
    assert np.sqrt(np.square(off).sum(axis=1).mean()) < 1.5 * expected_m(seen, seen.cov)


def test_a_checkpoint_keeps_the_covariances(taught) -> None:
    seen, learning = taught
    again = new_learning(nominal_model(pose_known=False))
    again.restore(learning.state())
    np.testing.assert_array_equal(again.state().arrays["cov"], seen.cov)


def test_a_checkpoint_without_covariances_is_read(taught) -> None:
    _, learning = taught
    state, again = learning.state(), new_learning(nominal_model(pose_known=False))
    arrays = {name: each for name, each in state.arrays.items() if name != "cov"}
    again.restore(replace(state, arrays=arrays))
    while again.work():
        pass
    assert "cov" not in again.state().arrays


@pytest.mark.parametrize("kind", [RigidLearner, ResidualLearner])
def test_weights_are_stored_with_a_model(kind: type[RigidLearner | ResidualLearner]) -> None:
    seen = Seen(7, ONE_CAMERA)
    learner = kind(BELIEF.parameters.reference, ChainTolerances(), BELIEF)
    learner.learn(seen.q, seen.x)
    learner.weigh(seen.cov)
    again = kind.from_bytes(learner.to_bytes())
    np.testing.assert_allclose(again.predict(seen.test), learner.predict(seen.test), atol=1e-7)
    np.testing.assert_allclose(again.estimate(seen.test).sigma, learner.estimate(seen.test).sigma, rtol=1e-2)
