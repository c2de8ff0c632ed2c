from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, control_points_needed, random_chain, random_q
from scipy.spatial.transform import Rotation

from kbmaps import NLMS, ExactLearner, KBMap, RigidChain, RotationError, SettingError, ShapeError, nearest_rotation
from kbmaps.rotations import rotation_matrices

pytestmark = pytest.mark.usefixtures("kernel_path")

seeds = st.integers(0, 2**32 - 1)
kinds = st.text("RP", min_size=1, max_size=5)


@given(joint_kinds=kinds, seed=seeds)
def test_map_orientation_equals_the_chain_orientation(joint_kinds, seed):
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
def test_the_orthonormal_orientation_is_a_proper_rotation(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    kbmap = disturbed_map(rng, joint_kinds, 0.05)
    rotations = kbmap.orientation(random_q(rng, joint_kinds, 10, 170), orthonormal=True)
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (10, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-12)


@given(joint_kinds=kinds, seed=seeds)
def test_angular_jacobian_is_derivative_of_orthonormal_orientation(joint_kinds, seed):
    rng = np.random.default_rng(seed)
    kbmap = disturbed_map(rng, joint_kinds, 0.02)
    q, step = random_q(rng, joint_kinds, 1, 170)[0], 1e-6
    there = kbmap.orientation(q + step * np.eye(len(q)), orthonormal=True)
    back = kbmap.orientation(q - step * np.eye(len(q)), orthonormal=True)
    turned = Rotation.from_matrix(there @ back.swapaxes(1, 2)).as_rotvec().T / (2 * step)
    np.testing.assert_allclose(kbmap.angular_jacobian(q), turned, atol=1e-6 * max(1.0, np.abs(turned).max()))
    np.testing.assert_allclose(kbmap.angular_jacobian(q[None])[0], kbmap.angular_jacobian(q), atol=1e-10)


@given(seed=seeds)
def test_no_rotation_is_nearer_than_the_nearest(seed):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(3, 3))
    nearest = nearest_rotation(matrix)
    others = [
        Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix() @ nearest,
        Rotation.random(rng=rng).as_matrix(),
    ]
    assert all(np.linalg.norm(matrix - nearest) <= np.linalg.norm(matrix - other) + 1e-12 for other in others)


def test_quaternions_are_in_xyzw_order():
    turned = rotation_matrices("R", [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    np.testing.assert_allclose(turned, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize("bad", [2 * np.eye(3), np.diag([1.0, 1.0, -1.0]), [0.0, 0.0, 0.0, 2.0]])
def test_invalid_rotations_are_refused(bad):
    with pytest.raises(RotationError):
        rotation_matrices("R", bad)


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((2, 3)), np.zeros((1, 2, 3, 3))])
def test_orientations_of_the_wrong_shape_are_refused(bad):
    with pytest.raises(ShapeError):
        rotation_matrices("R", bad)


def test_the_angular_jacobian_needs_an_orientation():
    with pytest.raises(ShapeError, match="orientation"):
        random_chain(np.random.default_rng(1), "R").to_kbmap(bases_for("R")).angular_jacobian([0.0])


# --- learning it


def shown(rng: np.random.Generator, joint_kinds: str, n: int) -> tuple[RigidChain, np.ndarray, np.ndarray]:
    """Return a chain, joint angles, and the poses there (n, 4, 4)."""
    chain = random_chain(rng, joint_kinds)
    q = random_q(rng, joint_kinds, n, 80)
    return chain, q, chain.poses(q)


def rough_prior(rng: np.random.Generator, joint_kinds: str) -> KBMap:
    return random_chain(rng, joint_kinds).to_kbmap(bases_for(joint_kinds), orientation=True)


@pytest.mark.parametrize("joint_kinds", ["R", "RPR", "RRRR"])
def test_minimum_number_of_poses_gives_orientations_everywhere(joint_kinds):
    rng = np.random.default_rng(3)
    chain, q, poses = shown(rng, joint_kinds, control_points_needed(joint_kinds))
    learner = ExactLearner(rough_prior(rng, joint_kinds))
    learner.learn(q, poses[:, :3, 3], rotation=Rotation.from_matrix(poses[:, :3, :3]).as_quat())
    learnt, anywhere = learner.solve().map, random_q(rng, joint_kinds, 100, 180)
    np.testing.assert_allclose(learnt.orientation(anywhere), chain.poses(anywhere)[:, :3, :3], atol=1e-9)
    np.testing.assert_allclose(learnt.predict(anywhere), chain.positions(anywhere), atol=1e-9)


@given(seed=seeds, precision=st.floats(1e-3, 10.0))
def test_positions_are_learnt_as_without_orientations(seed, precision):
    rng = np.random.default_rng(seed)
    prior = rough_prior(rng, "RRR")
    _, q, poses = shown(rng, "RRR", 40)
    x = poses[:, :3, 3] + 0.01 * rng.normal(size=(40, 3))
    alone, together = ExactLearner(KBMap(prior.bases, prior.net[:3])), ExactLearner(prior)
    alone.learn(q, x)
    together.learn(q, x, rotation=poses[:, :3, :3])
    for setting in (None, precision):
        one, other = alone.solve(setting), together.solve(setting)
        np.testing.assert_allclose(other.map.net[:3], one.map.net, atol=1e-8)
        assert other.noise_std == pytest.approx(one.noise_std, rel=1e-6)


def test_noisy_orientations_have_their_own_noise():
    rng = np.random.default_rng(4)
    _, q, poses = shown(rng, "RRR", 400)
    turned = Rotation.from_rotvec(0.02 * rng.normal(size=(400, 3))).as_matrix() @ poses[:, :3, :3]
    learner = ExactLearner(rough_prior(rng, "RRR"))
    learner.learn(q, poses[:, :3, 3] + 0.003 * rng.normal(size=(400, 3)), rotation=turned)
    for setting in (None, "evidence"):
        solution = learner.solve(setting)
        assert solution.noise_std == pytest.approx(0.003, rel=0.1)
        # A turn by a small vector of 0.02 a component moves an entry of the matrix by 0.02 · sqrt(2 / 3).
        assert solution.orientation_noise_std == pytest.approx(0.02 * np.sqrt(2 / 3), rel=0.1)


def test_orthonormalisation_brings_orientations_nearer_to_truth():
    rng = np.random.default_rng(5)
    chain, q, poses = shown(rng, "RRRR", 200)
    turned = Rotation.from_rotvec(0.05 * rng.normal(size=(200, 3))).as_matrix() @ poses[:, :3, :3]
    learner = ExactLearner(rough_prior(rng, "RRRR"))
    learner.learn(q, poses[:, :3, 3], rotation=turned)
    learnt, test = learner.solve("evidence").map, random_q(rng, "RRRR", 300, 80)
    truth = chain.poses(test)[:, :3, :3]
    errors = [np.linalg.norm(learnt.orientation(test, orthonormal=flag) - truth) for flag in (False, True)]
    assert errors[1] < 0.95 * errors[0]


@given(seed=seeds, joint_kinds=st.text("RP", min_size=1, max_size=4))
def test_blockwise_replay_of_poses_equals_single_steps(seed, joint_kinds):
    rng = np.random.default_rng(seed)
    _, q, poses = shown(rng, joint_kinds, 80)
    blocks = NLMS(rough_prior(rng, joint_kinds))
    one_by_one = NLMS(blocks.map)
    for row, pose in zip(q, poses, strict=True):
        one_by_one.learn(row, pose[:3, 3], pose[:3, :3])
    blocks.replay(q, poses[:, :3, 3], rotation=poses[:, :3, :3])
    np.testing.assert_allclose(blocks.map.net, one_by_one.map.net, atol=1e-9)


def test_orientations_are_learnt_step_by_step():
    rng = np.random.default_rng(6)
    _, q, poses = shown(rng, "RRR", 60)
    learner = NLMS(rough_prior(rng, "RRR"), mu0=1.0)
    for _ in range(200):
        learner.replay(q, poses[:, :3, 3], rotation=poses[:, :3, :3])
    np.testing.assert_allclose(learner.map.orientation(q), poses[:, :3, :3], atol=0.01)


def test_missing_or_surplus_rotations_are_refused():
    rng = np.random.default_rng(7)
    _, q, poses = shown(rng, "RR", 5)
    x, rotations, pose_map = poses[:, :3, 3], poses[:, :3, :3], rough_prior(rng, "RR")
    position_map = KBMap(pose_map.bases, pose_map.net[:3])
    for learner in (ExactLearner(pose_map), ExactLearner(position_map)):
        given_too_much = learner.prior is position_map
        with pytest.raises(SettingError):
            learner.learn(q, x, rotation=rotations if given_too_much else None)
        assert learner.pairs == 0
    with pytest.raises(SettingError):
        NLMS(pose_map).learn(q[0], x[0])
    with pytest.raises(SettingError):
        NLMS(position_map).replay(q, x, rotation=rotations)
    with pytest.raises(ShapeError):
        ExactLearner(pose_map).learn(q, x, rotation=rotations[:2])


def test_rebasing_a_pose_learner_requires_oriented_prior():
    prior = rough_prior(np.random.default_rng(8), "RR")
    with pytest.raises(ShapeError):
        ExactLearner(prior).rebase(KBMap(prior.bases, prior.net[:3]))
