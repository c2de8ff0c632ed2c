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


def test_a_rigid_arm_moves_as_the_chain_whose_numbers_it_has(chain, q):
    np.testing.assert_allclose(Arm.of(chain).positions(q), chain.positions(q), atol=1e-12)


def test_a_shifted_marker_is_seen_where_a_chain_with_that_tool_has_it(chain, q):
    shift = np.array([0.1, -0.02, 0.03])
    np.testing.assert_allclose(Arm.of(chain).positions(q, shift), chain.with_tool(shift).positions(q), atol=1e-12)


def test_an_eccentric_encoder_errs_by_its_size_once_a_turn(chain):
    turn = np.tile(np.linspace(0.0, 2.0 * np.pi, 721)[:, None], (1, 6))
    error = Eccentric(math.radians(1.0), np.arange(6.0))(Arm.of(chain), turn) - turn
    np.testing.assert_allclose(np.abs(error).max(axis=0), math.radians(1.0), rtol=1e-4)


def test_a_gear_gain_of_one_per_cent_turns_by_one_per_cent_more(chain, q):
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
def test_sag_bends_the_most_loaded_joint_by_about_what_it_says(chain, degrees, rng):
    poses = rng.uniform(-np.pi / 2, np.pi / 2, (400, 6))
    deflections = np.abs(Sag.on(6, math.radians(degrees))(Arm.of(chain), poses) - poses)
    assert np.degrees(deflections.max()) == pytest.approx(degrees, rel=0.2)
    assert deflections[:, :2].max() == 0.0


def test_the_cameras_scales_are_off_by_two_to_three_per_cent(rng):
    scales = np.abs(np.diag(Affine.drawn(rng).matrix) - 1.0)
    assert ((scales >= 0.02) & (scales <= 0.03)).all()


def test_radial_distortion_is_two_per_cent_at_its_radius():
    seen = Radial(0.02, 0.5, np.zeros(3))(np.array([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(seen, [[0.51, 0.0, 0.0], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize("key", [key for key in BENT if key != "rigid"])
def test_no_rigid_chain_is_the_truth_of_a_bent_task(key):
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


def test_noise_free_truth_is_asked_for_and_the_pairs_carry_the_noise():
    trial = Setting()(0, 2000)
    assert trial is not None
    assert trial.arm is not None
    noise = trial.problem.x - trial.arm.positions(trial.problem.q)
    assert noise.std() == pytest.approx(0.01, rel=0.05)


def test_the_pairs_of_one_seed_begin_alike_whatever_their_number():
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


def test_the_tool_moves_by_a_quarter_metre_between_the_pairs_before_and_after():
    trial = next(task for task in simulated_tasks() if task.key == "tool").trial(0, 10)
    assert trial is not None
    assert trial.before is not None
    assert trial.arm is not None
    before = trial.before.x - trial.arm.positions(trial.before.q)
    assert np.linalg.norm(before, axis=1).mean() == pytest.approx(0.25, rel=0.02)


def test_a_local_zone_spans_forty_degrees_and_is_asked_beyond():
    trial = next(task for task in simulated_tasks() if task.key == "local").trial(0, 300)
    assert trial is not None
    assert np.degrees(np.ptp(trial.problem.q, axis=0)).max() <= 40.0
    assert np.degrees(np.ptp(trial.tests["extrapolated"][0], axis=0)).min() > 150.0
