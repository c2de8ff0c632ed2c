from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planted_chains import bases_for, random_chain, random_q
from scipy.spatial.transform import Rotation

from kbmaps import KBMap, RotationError, ShapeError, nearest_rotation
from kbmaps.rotations import rotation_matrices

seeds = st.integers(0, 2**32 - 1)
kinds = st.text("RP", min_size=1, max_size=5)


@given(joint_kinds=kinds, seed=seeds)
@settings(max_examples=30)
def test_the_maps_of_a_chain_s_unit_vectors_are_its_orientation(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joint_kinds)
    kbmap = chain.to_kbmap(bases_for(joint_kinds), orientation=True)
    q = random_q(rng, joint_kinds, 10, 170)
    np.testing.assert_allclose(kbmap.orientation(q), chain.poses(q)[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(kbmap.orientation(q[0]), chain.poses(q[0])[:3, :3], atol=1e-12)


def disturbed_map(rng: np.random.Generator, joint_kinds: str, size: float) -> KBMap:
    kbmap = random_chain(rng, joint_kinds).to_kbmap(bases_for(joint_kinds), orientation=True)
    return KBMap(kbmap.bases, kbmap.net + size * rng.normal(size=kbmap.net.shape))


@given(joint_kinds=kinds, seed=seeds)
@settings(max_examples=30)
def test_the_orthonormal_orientation_is_a_proper_rotation(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    kbmap = disturbed_map(rng, joint_kinds, 0.05)
    rotations = kbmap.orientation(random_q(rng, joint_kinds, 10, 170), orthonormal=True)
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (10, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-12)


@given(joint_kinds=kinds, seed=seeds)
@settings(max_examples=30)
def test_the_angular_jacobian_is_how_the_orthonormal_orientation_turns(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    kbmap = disturbed_map(rng, joint_kinds, 0.02)
    q, step = random_q(rng, joint_kinds, 1, 170)[0], 1e-6
    there = kbmap.orientation(q + step * np.eye(len(q)), orthonormal=True)
    back = kbmap.orientation(q - step * np.eye(len(q)), orthonormal=True)
    turned = Rotation.from_matrix(there @ back.swapaxes(1, 2)).as_rotvec().T / (2 * step)
    np.testing.assert_allclose(kbmap.angular_jacobian(q), turned, atol=1e-6 * max(1.0, np.abs(turned).max()))
    np.testing.assert_allclose(kbmap.angular_jacobian(q[None])[0], kbmap.angular_jacobian(q), atol=1e-10)


@given(seed=seeds)
@settings(max_examples=50)
def test_no_rotation_is_nearer_than_the_nearest(seed):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(3, 3))
    nearest = nearest_rotation(matrix)
    others = [
        Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix() @ nearest,
        Rotation.random(rng=rng).as_matrix(),
    ]
    assert all(np.linalg.norm(matrix - nearest) <= np.linalg.norm(matrix - other) + 1e-12 for other in others)


def test_quaternions_are_in_the_order_x_y_z_w():
    turned = rotation_matrices("R", [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    np.testing.assert_allclose(turned, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize("bad", [2 * np.eye(3), np.diag([1.0, 1.0, -1.0]), [0.0, 0.0, 0.0, 2.0]])
def test_what_is_no_rotation_is_refused(bad):
    with pytest.raises(RotationError):
        rotation_matrices("R", bad)


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((2, 3)), np.zeros((1, 2, 3, 3))])
def test_orientations_of_the_wrong_shape_are_refused(bad):
    with pytest.raises(ShapeError):
        rotation_matrices("R", bad)


def test_the_angular_jacobian_needs_an_orientation():
    with pytest.raises(ShapeError, match="orientation"):
        random_chain(np.random.default_rng(1), "R").to_kbmap(bases_for("R")).angular_jacobian([0.0])
