from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planted_chains import random_chain, random_q
from scipy.spatial.transform import Rotation

from kbmaps import (
    ChainBelief,
    ChainParameters,
    ChainTolerances,
    DegenerateDataError,
    OrientedChain,
    RigidLearner,
    ShapeError,
    fitted_orientation,
    rotation_vectors,
)

KINDS = "RRPRRR"
TOLERANCES = ChainTolerances(
    axes=0.03, points=0.01, zeros=0.05, slide_zeros=0.01, tool=0.03, base_rotation=0.05, base_translation=0.03
)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles between rotations (n, 3, 3) [rad], shape (n,)."""
    return np.linalg.norm(rotation_vectors(a @ b.swapaxes(-1, -2)), axis=1)


class Arm:
    """A built arm with a tag on its hand, and its nominal model."""

    def __init__(self, seed: int, kinds: str = KINDS) -> None:
        self.rng = np.random.default_rng(seed)
        self.kinds, self.drawn = kinds, random_chain(self.rng, kinds)
        self.belief = ChainBelief.from_tolerances(ChainParameters(self.drawn), TOLERANCES)
        std = self.belief.parameters.standard_deviations(TOLERANCES)
        self.built = self.belief.parameters.chain(std * self.rng.normal(size=len(std)))
        self.turn = Rotation.random(rng=self.rng).as_matrix()

    def measured(self, n: int, sigma: float) -> tuple[np.ndarray, np.ndarray]:
        q = random_q(self.rng, self.kinds, n, 60.0)
        noise = Rotation.from_rotvec(sigma * self.rng.normal(size=(n, 3))).as_matrix()
        return q, noise @ self.truth(q)

    def truth(self, q: np.ndarray) -> np.ndarray:
        return self.built.orientation(q) @ self.turn

    def held_out(self) -> np.ndarray:
        return random_q(self.rng, self.kinds, 300, 60.0)


def test_parameter_rotation_jacobian_matches_finite_differences() -> None:
    arm = Arm(0)
    parameters, q = arm.belief.parameters, random_q(arm.rng, KINDS, 4, 60.0)
    change = 0.1 * arm.rng.normal(size=parameters.size)
    rotations, omega = parameters.turned(change, q)
    for k in range(parameters.size):
        step = 1e-6 * np.eye(parameters.size)[k]
        turned = rotation_vectors(parameters.turned(change + step, q)[0] @ rotations.swapaxes(1, 2)) / 1e-6
        assert turned == pytest.approx(omega[:, :, k], abs=1e-5)


def test_the_turned_frame_is_that_of_the_chain() -> None:
    arm = Arm(1)
    parameters, q = arm.belief.parameters, random_q(arm.rng, KINDS, 5, 60.0)
    change = 0.1 * arm.rng.normal(size=parameters.size)
    assert parameters.turned(change, q)[0] == pytest.approx(parameters.chain(change).orientation(q), abs=1e-9)


def test_exact_orientations_of_known_arm_recover_marker_rotation() -> None:
    arm = Arm(2)
    known = ChainBelief(arm.belief.parameters, np.zeros(arm.belief.parameters.size), np.zeros_like(arm.belief.root))
    turn = Rotation.random(rng=arm.rng).as_matrix()
    q = random_q(arm.rng, KINDS, 3, 60.0)
    found = fitted_orientation(known, q, arm.drawn.orientation(q) @ turn)
    assert found.turn == pytest.approx(turn, abs=1e-9)


def test_orientations_are_learnt_for_non_nominal_arm() -> None:
    arm = Arm(3)
    found = fitted_orientation(arm.belief, *arm.measured(300, 0.005))
    q = arm.held_out()
    assert angles(found.orientation(q), arm.truth(q)).mean() < 0.0015  # the noise is 8 mrad long


def test_ten_percent_gross_orientation_outliers_are_tolerated() -> None:
    arm = Arm(4)
    q, measured = arm.measured(200, 0.005)
    measured[::10] = Rotation.random(20, rng=arm.rng).as_matrix()
    found = fitted_orientation(arm.belief, q, measured)
    q = arm.held_out()
    assert angles(found.orientation(q), arm.truth(q)).mean() < 0.003


def test_the_claimed_sigma_covers() -> None:
    shares = []
    for seed in range(20):
        arm = Arm(100 + seed)
        found = fitted_orientation(arm.belief, *arm.measured(60, 0.01))
        q = arm.held_out()
        rotations, variance = found.orientation_with_variance(q)
        errors = rotation_vectors(rotations @ arm.truth(q).swapaxes(1, 2))
        shares.append((np.abs(errors) < np.sqrt(variance)).mean())
    assert 0.60 < np.mean(shares) < 0.75


def test_chain_belief_from_positions_improves_orientations() -> None:
    arm = Arm(5)
    q = random_q(arm.rng, KINDS, 400, 60.0)
    learner = RigidLearner(arm.drawn, TOLERANCES)
    learner.learn(q, arm.built.positions(q) + 1e-4 * arm.rng.normal(size=(400, 3)), 1e-4)
    few = arm.measured(5, 0.002)
    with_positions, without = fitted_orientation(learner.belief, *few), fitted_orientation(arm.belief, *few)
    q = arm.held_out()
    errors = [angles(found.orientation(q), arm.truth(q)).mean() for found in (with_positions, without)]
    assert errors[0] < 0.5 * errors[1]


def test_one_orientation_is_enough_to_begin() -> None:
    arm = Arm(6)
    q, measured = arm.measured(1, 0.0)
    found = fitted_orientation(arm.belief, q, measured)
    assert angles(found.orientation(q), measured)[0] < 1e-6


def test_without_orientations_there_is_nothing_to_fit() -> None:
    with pytest.raises(DegenerateDataError, match="no orientations"):
        fitted_orientation(Arm(7).belief, np.empty((0, 6)), np.empty((0, 3, 3)))


def test_orientations_of_other_pairs_are_refused() -> None:
    arm = Arm(8)
    q, measured = arm.measured(4, 0.0)
    with pytest.raises(ShapeError, match="to go with q"):
        fitted_orientation(arm.belief, q[:3], measured)


def test_quaternions_give_same_fit_as_matrices() -> None:
    arm = Arm(9)
    q, measured = arm.measured(50, 0.01)
    by_matrix = fitted_orientation(arm.belief, q, measured)
    by_quaternion = fitted_orientation(arm.belief, q, Rotation.from_matrix(measured).as_quat())
    assert by_quaternion.turn == pytest.approx(by_matrix.turn, abs=1e-9)


def test_bytes_give_back_the_same_chain() -> None:
    arm = Arm(10)
    found = fitted_orientation(arm.belief, *arm.measured(30, 0.01))
    again = OrientedChain.from_bytes(found.to_bytes())
    q = arm.held_out()
    assert all(
        np.array_equal(a, b)
        for a, b in zip(found.orientation_with_variance(q), again.orientation_with_variance(q), strict=True)
    )


def test_fitted_chain_ends_in_the_marker_frame() -> None:
    arm = Arm(11)
    found = fitted_orientation(arm.belief, *arm.measured(30, 0.01))
    q = arm.held_out()
    assert found.chain.orientation(q) == pytest.approx(found.orientation(q), abs=1e-9)


def test_a_turn_of_another_shape_is_refused() -> None:
    arm = Arm(12)
    found = fitted_orientation(arm.belief, *arm.measured(3, 0.01))
    with pytest.raises(ShapeError, match="turn"):
        replace(found, turn=np.eye(2))
