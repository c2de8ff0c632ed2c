from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, random_chain, random_q
from scipy.spatial.transform import Rotation

from kbmaps import (
    BasisError,
    ChainError,
    JointBasis,
    KernelLearner,
    NetSizeError,
    NonFiniteError,
    RigidChain,
    ShapeError,
    TensorTrain,
)

kinds = st.text("RP", min_size=1, max_size=6)
seeds = st.integers(0, 2**32 - 1)


def composed_pose(chain: RigidChain, q: np.ndarray) -> np.ndarray:
    """Return T(q) multiplied out with scipy's rotations."""
    pose = chain.fixed[0]
    for k, value in enumerate(q):
        motion = np.eye(4)
        if chain.prismatic[k]:
            motion[:3, 3] = value * chain.axes[k]
        else:
            motion[:3, :3] = Rotation.from_rotvec(value * chain.axes[k]).as_matrix()
        pose = pose @ motion @ chain.fixed[k + 1]
    return pose


@given(joint_kinds=kinds, seed=seeds)
def test_poses_are_the_product_of_the_transforms(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joint_kinds)
    q = random_q(rng, joint_kinds, 3, 180)
    np.testing.assert_allclose(chain.poses(q), [composed_pose(chain, row) for row in q], rtol=0, atol=1e-13)
    np.testing.assert_allclose(chain.poses(q[0]), composed_pose(chain, q[0]), rtol=0, atol=1e-13)


@given(joint_kinds=kinds, seed=seeds)
def test_batch_frames_equal_single_frames(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joint_kinds)
    q = random_q(rng, joint_kinds, 3, 180)
    frames = chain.frames(q)
    np.testing.assert_allclose(frames, [chain.frames(row) for row in q], rtol=0, atol=1e-13)
    np.testing.assert_allclose(frames[:, -1], chain.poses(q), rtol=0, atol=1e-13)


@given(joint_kinds=kinds, seed=seeds)
def test_the_jacobian_agrees_with_finite_differences(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joint_kinds)
    q = random_q(rng, joint_kinds, 1, 180)[0]
    moves = 1e-6 * np.eye(len(q))
    slopes = (chain.positions(q + moves) - chain.positions(q - moves)).T / 2e-6
    np.testing.assert_allclose(chain.jacobian(q), slopes, rtol=0, atol=1e-8)


@given(joint_kinds=kinds, seed=seeds)
def test_control_net_is_exact_over_the_full_turn(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joint_kinds)
    q = random_q(rng, joint_kinds, 50, 180)
    np.testing.assert_allclose(
        chain.to_kbmap(bases_for(joint_kinds)).predict(q), chain.positions(q), rtol=0, atol=1e-13
    )


def test_seven_joint_bernstein_net_is_exact_to_picometres():
    rng = np.random.default_rng(5)
    chain = random_chain(rng, "R" * 7)
    q = random_q(rng, "R" * 7, 500, 180)
    kbmap = chain.to_kbmap([JointBasis.bernstein(np.radians(60))] * 7)
    assert np.abs(kbmap.predict(q) - chain.positions(q)).max() < 2e-12


@given(joint_kinds=kinds, seed=seeds)
def test_the_orientation_planes_give_the_rotation_matrix(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joint_kinds)
    q = random_q(rng, joint_kinds, 5, 180)
    kbmap = chain.to_kbmap(bases_for(joint_kinds), orientation=True)
    np.testing.assert_allclose(kbmap.orientation(q), chain.poses(q)[:, :3, :3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(kbmap.predict(q), chain.positions(q), rtol=0, atol=1e-12)


@given(joint_kinds=kinds, seed=seeds)
def test_tool_shift_adds_orientation_planes_to_net(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    chain, shift = random_chain(rng, joint_kinds), rng.normal(size=3)
    bases = bases_for(joint_kinds)
    net = chain.to_kbmap(bases).net
    axes = chain.orientation_maps(bases).reshape(3, 3, *net.shape[1:])
    moved = chain.with_tool(shift).to_kbmap(bases).net
    np.testing.assert_allclose(moved, net + np.tensordot(shift, axes, axes=1), rtol=0, atol=1e-12)


def test_transformed_chain_gives_poses_in_new_frame():
    rng = np.random.default_rng(1)
    chain = random_chain(rng, "RRP")
    T_new_old = np.eye(4)
    T_new_old[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T_new_old[:3, 3] = (1.0, 2.0, 3.0)
    q = random_q(rng, "RRP", 1, 90)[0]
    np.testing.assert_allclose(chain.transformed(T_new_old).poses(q), T_new_old @ chain.poses(q), atol=1e-13)


def test_a_mirror_is_no_rigid_transform():
    with pytest.raises(ChainError, match="rigid"):
        random_chain(np.random.default_rng(1), "R").transformed(np.diag([1.0, 1.0, -1.0, 1.0]))


def test_non_unit_axes_are_refused():
    with pytest.raises(ChainError, match=r"axes\[1\]"):
        RigidChain(np.tile(np.eye(4), (3, 1, 1)), np.array([[0, 0, 1], [0, 0, 2]]), np.zeros(2, dtype=bool))


def test_a_chain_with_too_few_transforms_is_refused():
    with pytest.raises(ShapeError):
        RigidChain(np.tile(np.eye(4), (2, 1, 1)), np.array([[0, 0, 1], [0, 0, 1]]), np.zeros(2, dtype=bool))


def test_a_chain_with_nan_is_refused():
    fixed = np.tile(np.eye(4), (2, 1, 1))
    fixed[1, 0, 3] = np.nan
    with pytest.raises(NonFiniteError):
        RigidChain(fixed, np.array([[0.0, 0, 1]]), np.zeros(1, dtype=bool))


def test_revolute_basis_for_prismatic_joint_is_refused():
    with pytest.raises(BasisError, match=r"joint 2 of 2 is prismatic .* learning_bases\(low, high, prismatic="):
        random_chain(np.random.default_rng(1), "RP").to_kbmap([JointBasis.trigonometric()] * 2)


@pytest.mark.parametrize("orientation", [False, True])
def test_twenty_joint_map_error_states_size_and_alternative(orientation):
    bases, chain = bases_for("R" * 20), random_chain(np.random.default_rng(0), "R" * 20)
    with pytest.raises(NetSizeError, match=r"3,486,784,401 control points, (77\.9|312) GiB.*InverseKinematics"):
        chain.to_kbmap(bases, orientation=orientation)
    with pytest.raises(NetSizeError):
        TensorTrain.from_chain(chain, bases).to_kbmap()
    with pytest.raises(NetSizeError):
        KernelLearner(bases, chain).to_kbmap()


@given(seed=seeds, joint_kinds=kinds)
def test_angular_jacobian_is_derivative_of_marker_orientation(seed, joint_kinds):
    rng = np.random.default_rng(seed)
    chain, step = random_chain(rng, joint_kinds), 1e-6
    q = random_q(rng, joint_kinds, 1, 180)[0]
    for k, move in enumerate(step * np.eye(len(joint_kinds))):
        turn = Rotation.from_matrix(chain.orientation(q + move) @ chain.orientation(q - move).T).as_rotvec()
        np.testing.assert_allclose(chain.angular_jacobian(q)[:, k], turn / (2.0 * step), rtol=0, atol=1e-7)
