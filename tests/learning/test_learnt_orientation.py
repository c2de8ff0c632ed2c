from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from guided_arm import NOW_AND_THEN, Scene, built_chain, measured, near, new_learning, nominal_model, path, teach
from scipy.spatial.transform import Rotation

from bodyschema.daemon.learner.checkpoint import read_checkpoint, write_checkpoint
from bodyschema.daemon.learner.solver_process import SolverProcess
from bodyschema.interfaces.records import FloatArray, Pair, frozen_array
from bodyschema.learning.online_learner import OnlineLearner
from kbmaps import RigidChain, rotation_vectors

SIGMA_RAD = 0.01
TURN = Rotation.from_rotvec([0.3, -1.9, 0.7]).as_matrix()


def turned(pairs: Sequence[Pair], chain: RigidChain, seed: int = 0, sigma_rad: float = SIGMA_RAD) -> list[Pair]:
    """Return the pairs with the orientation of a tag on the hand, measured with noise."""
    rng = np.random.default_rng(seed)
    truth = chain.orientation(np.array([pair.q for pair in pairs])) @ TURN
    noisy = Rotation.from_rotvec(sigma_rad * rng.normal(size=(len(pairs), 3))).as_matrix() @ truth
    cov = frozen_array(sigma_rad**2 * np.eye(3))
    return [
        replace(pair, R=frozen_array(quaternion), cov_R=cov)
        for pair, quaternion in zip(pairs, Rotation.from_matrix(noisy).as_quat(), strict=True)
    ]


def errors_rad(learning: OnlineLearner, chain: RigidChain, q: FloatArray) -> FloatArray:
    """Return the orientation error of the answers about each axis (n, 3) [rad]."""
    answer = learning.snapshot.predict(q)
    assert answer.R is not None
    truth = chain.orientation(q) @ TURN
    return rotation_vectors(Rotation.from_quat(answer.R).as_matrix() @ truth.swapaxes(1, 2))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.draw(3, 120)


@pytest.fixture(scope="module")
def taught(scene: Scene) -> OnlineLearner:
    learning = new_learning()
    teach(learning, turned(scene.pairs, scene.chain), every=NOW_AND_THEN)
    return learning


def test_learnt_tag_orientation_beats_the_measurement_noise(scene, taught) -> None:
    q = near(np.random.default_rng(0), scene.q)
    angle = np.linalg.norm(errors_rad(taught, scene.chain, q), axis=1).mean()
    assert angle < 0.4 * SIGMA_RAD


def test_the_claimed_angle_is_about_the_true_one(scene, taught) -> None:
    q = near(np.random.default_rng(1), scene.q)
    status = taught.orientation_status()
    assert status is not None
    assert status.claimed_rad is not None
    angle = np.linalg.norm(errors_rad(taught, scene.chain, q), axis=1).mean()
    assert 0.4 < status.claimed_rad / angle < 3.0


def test_status_reports_orientation_errors_of_models(taught) -> None:
    status = taught.orientation_status()
    assert status is not None
    assert (status.pairs, status.answering) == (120, "rigid")
    assert set(status.prequential_rad) == {"prior", "rigid", "exact"}
    assert status.prequential_rad["rigid"] < status.prequential_rad["prior"]


def test_positions_are_learnt_as_without_orientations(scene) -> None:
    one, other = new_learning(), new_learning()
    teach(one, scene.pairs[:40], every=NOW_AND_THEN)
    teach(other, turned(scene.pairs[:40], scene.chain), every=NOW_AND_THEN)
    assert np.array_equal(one.snapshot.predict(scene.q).x, other.snapshot.predict(scene.q).x)


def test_pairs_without_orientation_give_predictions_without(scene) -> None:
    learning = new_learning()
    teach(learning, scene.pairs[:30], every=NOW_AND_THEN)
    assert learning.snapshot.predict(scene.q).R is None
    assert learning.orientation_status() is None


def test_the_first_orientation_is_answered_with_at_once(scene) -> None:
    learning = new_learning()
    teach(learning, turned(scene.pairs[:1], scene.chain), background=False)
    assert np.linalg.norm(errors_rad(learning, scene.chain, scene.q[:1])) < 5 * SIGMA_RAD


def test_wild_orientations_among_them_are_borne(scene) -> None:
    pairs = turned(scene.pairs[:60], scene.chain)
    wild = Rotation.random(6, rng=np.random.default_rng(5)).as_quat()
    pairs[5::10] = [replace(pair, R=frozen_array(R)) for pair, R in zip(pairs[5::10], wild, strict=True)]
    learning = new_learning()
    teach(learning, pairs, every=NOW_AND_THEN)
    q = near(np.random.default_rng(2), scene.q[:60])
    assert np.linalg.norm(errors_rad(learning, scene.chain, q), axis=1).mean() < SIGMA_RAD


def test_another_tool_has_its_own_turn(scene, taught) -> None:
    learning = new_learning()
    learning.restore(taught.state())
    learning.tool_changed()
    assert learning.snapshot.predict(scene.q).R is None


def test_orientations_are_learnt_with_unknown_camera_pose(scene) -> None:
    learning = new_learning(nominal_model(pose_known=False))
    teach(learning, turned(scene.pairs[:60], scene.chain), every=NOW_AND_THEN)
    q = near(np.random.default_rng(3), scene.q[:60])
    assert np.linalg.norm(errors_rad(learning, scene.chain, q), axis=1).mean() < SIGMA_RAD


def test_checkpoint_keeps_learnt_orientations(scene, taught, tmp_path: Path) -> None:
    file = tmp_path / "checkpoint"
    write_checkpoint(file, taught.state(), robot="arm", utc="")
    state = read_checkpoint(file, robot="arm")
    assert state is not None
    restored = new_learning()
    restored.restore(state)
    before, after = taught.snapshot.predict(scene.q), restored.snapshot.predict(scene.q)
    assert np.array_equal(before.R, after.R)
    assert np.array_equal(before.sigma_R, after.sigma_R)
    assert restored.orientation_status() == taught.orientation_status()


def test_orientations_are_learnt_again_after_a_restart(scene, taught) -> None:
    restored = new_learning()
    restored.restore(taught.state())
    while restored.work():
        pass
    q = near(np.random.default_rng(4), scene.q)
    assert np.linalg.norm(errors_rad(restored, scene.chain, q), axis=1).mean() < 0.4 * SIGMA_RAD


def test_exported_map_contains_the_learnt_orientation(scene, taught) -> None:
    kbmap = taught.snapshot.require_map()
    q = near(np.random.default_rng(5), scene.q)
    answer = taught.snapshot.predict(q)
    assert kbmap.has_orientation
    assert answer.R is not None
    angles = rotation_vectors(
        kbmap.orientation(q, orthonormal=True) @ Rotation.from_quat(answer.R).as_matrix().swapaxes(1, 2)
    )
    assert np.abs(angles).max() < 1e-6


@pytest.mark.soak
def test_solver_process_finds_same_orientations_as_direct_solver() -> None:
    chain, q = built_chain(np.random.default_rng(6)), path(np.random.default_rng(7), 30)
    pairs = turned(measured(chain, q, np.random.default_rng(8)), chain)
    direct = new_learning()
    teach(direct, pairs, background=False)
    while direct.work():
        pass
    with SolverProcess() as solver:
        apart = OnlineLearner(nominal_model(), direct._settings, solver)
        teach(apart, pairs, background=False)
        while not apart.at_rest:
            if not apart.work():
                time.sleep(0.005)  # leave the processor to the solver's process
    assert pytest.approx(apart.snapshot.predict(q).R, abs=1e-9) == direct.snapshot.predict(q).R


@pytest.mark.soak
def test_exact_orientation_map_answers_for_compliant_arm() -> None:
    """Check an arm with compliance, whose orientations no rigid chain has."""
    rng = np.random.default_rng(9)
    chain, q = built_chain(rng), rng.uniform(-1.0, 1.0, (200, 4))
    pairs = turned(measured(chain, q, rng), chain, sigma_rad=0.002)
    sag = Rotation.from_rotvec(np.column_stack([0.1 * np.cos(q[:, 1] + q[:, 2]), 0.08 * np.sin(q[:, 0]), 0 * q[:, 0]]))
    pairs = [
        replace(pair, R=frozen_array((bent * Rotation.from_quat(pair.R)).as_quat()))
        for pair, bent in zip(pairs, sag, strict=True)
        if pair.R is not None
    ]
    learning = new_learning()
    teach(learning, pairs, every=100)
    status = learning.orientation_status()
    assert status is not None
    assert status.answering == "exact"
