"""The arms that learners are measured against match their names."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.peers.tasks import BENT, Setting, simulated_tasks
from benchmarks.peers.truths import Affine, Arm, Eccentric, GearGain, Radial, Sag
from benchmarks.rough_arm import rough_arm


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


@pytest.fixture
def chain(rng):
    return rough_arm(6, rng).drawing


@pytest.fixture
def q(rng):
    return rng.uniform(-1.4, 1.4, (40, 6))


def test_rigid_arm_matches_its_chain(chain, q):
    np.testing.assert_allclose(Arm.of(chain).positions(q), chain.positions(q), atol=1e-12)


def test_shifted_marker_matches_chain_with_that_tool(chain, q):
    shift = np.array([0.1, -0.02, 0.03])
    np.testing.assert_allclose(Arm.of(chain).positions(q, shift), chain.with_tool(shift).positions(q), atol=1e-12)


def test_eccentric_encoder_errs_once_per_turn(chain):
    turn = np.tile(np.linspace(0.0, 2.0 * np.pi, 721)[:, None], (1, 6))
    error = Eccentric(math.radians(1.0), np.arange(6.0))(Arm.of(chain), turn) - turn
    np.testing.assert_allclose(np.abs(error).max(axis=0), math.radians(1.0), rtol=1e-4)


def test_gear_gain_scales_the_turn(chain, q):
    np.testing.assert_allclose(GearGain(np.full(6, 1.01))(Arm.of(chain), q), 1.01 * q)


def test_sag_is_the_equilibrium_of_springs_and_weight(chain, q):
    arm, sag = Arm.of(chain), Sag.on(6, math.radians(3.0))
    bent = sag(arm, q)
    given, torques = (bent - q)[:, sag.first :], sag.torques(arm, bent)
    compliance = (given * torques).sum(axis=0) / np.square(torques).sum(axis=0).clip(1e-12)
    assert (compliance[1:] > 0.0).all()
    np.testing.assert_allclose(given, compliance * torques, atol=math.radians(1e-3))


def test_torques_are_the_slope_of_the_potential_energy(chain, q):
    arm, sag = Arm.of(chain), Sag.on(6, math.radians(1.0))
    torso = Arm(np.concatenate([np.eye(4)[None], arm.fixed[sag.first + 1 :]]), arm.axes[sag.first :])

    def energy(angles):
        return 9.81 * (sag.masses[:, None] * torso.frames(angles[:, sag.first :])[1][1:, :, 2]).sum(axis=0)

    step = 1e-6
    for k in range(sag.first, 6):
        up, down = q.copy(), q.copy()
        up[:, k] += step
        down[:, k] -= step
        slope = (energy(up) - energy(down)) / (2.0 * step)
        np.testing.assert_allclose(sag.torques(arm, q)[:, k - sag.first], -slope, atol=1e-6)


@pytest.mark.parametrize("degrees", [1.0, 3.0])
def test_sag_bends_most_loaded_joint_as_stated(chain, degrees, rng):
    poses = rng.uniform(-np.pi / 2, np.pi / 2, (400, 6))
    deflections = np.abs(Sag.on(6, math.radians(degrees))(Arm.of(chain), poses) - poses)
    assert np.degrees(deflections.max()) == pytest.approx(degrees, rel=0.2)
    assert deflections[:, :2].max() == 0.0


def test_camera_scales_err_two_to_three_percent(rng):
    scales = np.abs(np.diag(Affine.drawn(rng).matrix) - 1.0)
    assert ((scales >= 0.02) & (scales <= 0.03)).all()


def test_radial_distortion_is_two_per_cent():
    seen = Radial(0.02, 0.5, np.zeros(3))(np.array([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(seen, [[0.51, 0.0, 0.0], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize("key", [key for key in BENT if key != "rigid"])
def test_bent_task_has_no_rigid_truth(key):
    setting = BENT[key][1]
    trial, rigid = setting(3, 30), BENT["rigid"][1](3, 30)
    assert trial is not None
    assert rigid is not None
    (q, bent), (same, straight) = trial.tests["drawn alike"], rigid.tests["drawn alike"]
    np.testing.assert_array_equal(q.shape, same.shape)
    assert trial.arm is None
    assert rigid.arm is not None
    off = np.linalg.norm(bent - rigid.arm.positions(q), axis=1).mean()
    assert 0.002 < off < 0.08
    assert np.linalg.norm(straight - rigid.arm.positions(same), axis=1).max() < 1e-12


def test_truth_is_noise_free_and_pairs_are_noisy():
    trial = Setting()(0, 2000)
    assert trial is not None
    assert trial.arm is not None
    noise = trial.problem.x - trial.arm.positions(trial.problem.q)
    assert noise.std() == pytest.approx(0.01, rel=0.05)


def test_pairs_of_one_seed_share_their_beginning():
    few, many = Setting()(4, 30), Setting()(4, 100)
    np.testing.assert_array_equal(few.problem.x, many.problem.x[:30])
    np.testing.assert_array_equal(few.tests["drawn alike"][1], many.tests["drawn alike"][1])


def test_a_rough_drawing_errs_as_its_tolerances_say():
    errors = []
    for seed in range(40):
        trial = Setting()(seed, 30)
        assert trial.arm is not None
        q, x = trial.tests["drawn alike"]
        errors.append(np.linalg.norm(trial.arm.drawing.positions(q) - x, axis=1).mean())
    assert 0.07 < np.mean(errors) < 0.11


def test_tool_change_is_a_quarter_metre():
    trial = next(task for task in simulated_tasks() if task.key == "tool").trial(0, 10)
    assert trial is not None
    assert trial.before is not None
    assert trial.arm is not None
    before = trial.before.x - trial.arm.positions(trial.before.q)
    assert np.linalg.norm(before, axis=1).mean() == pytest.approx(0.25, rel=0.02)


def test_local_zone_spans_forty_degrees_and_tests_beyond():
    trial = next(task for task in simulated_tasks() if task.key == "local").trial(0, 300)
    assert trial is not None
    assert np.degrees(np.ptp(trial.problem.q, axis=0)).max() <= 40.0
    assert np.degrees(np.ptp(trial.tests["extrapolated"][0], axis=0)).min() > 150.0
