from __future__ import annotations

import numpy as np
import pytest
from planted_chains import random_q
from rough_arms import ROUGH, rough_arm

from kbmaps import ChainPosterior, Forecast, RigidLearner, SettingError, candidate_motions, expected_gain
from kbmaps.planning.expected_gain import ALL, SAME

LIMIT = np.radians(80.0)


def learner_of(arm, rng, pairs, reach_deg=80.0, told=0.01):
    learner = RigidLearner(arm.nominal, ROUGH)
    q, x = arm.pairs(rng, pairs, 0.01, reach_deg)
    learner.learn(q, x, told)
    return learner, q


def foretold_and_found(seeds, first, first_deg, further, motion, told):
    """Return predicted and observed mean errors [m], now and after further pairs, over many arms."""
    rows = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng)
        learner, q = learner_of(arm, rng, first, first_deg, told)
        limits = np.full(6, LIMIT)
        region = random_q(rng, arm.kinds, 150, 80)
        motions = candidate_motions(q, -limits, limits, rng)
        forecast = expected_gain(ChainPosterior.of(learner), region, {motion: motions[motion]}, (further,), rng)
        now = arm.error(learner, rng)
        reach = first_deg if motion == SAME else 80.0
        learner.learn(*arm.pairs(rng, further, 0.01, reach), told)
        rows.append((forecast.now, now, forecast.error_after(motion, further), arm.error(learner, rng)))
    return np.mean(rows, axis=0)


@pytest.mark.parametrize(("first", "first_deg", "further", "motion"), [(40, 80, 80, SAME)])
def test_forecast_errors_match_observed_errors(first, first_deg, further, motion):
    now, now_found, later, later_found = foretold_and_found(20, first, first_deg, further, motion, 0.01)
    # 20 arms leave a standard error of about 4 % (at 80 degrees) and 8 % (from 20) in a ratio.
    assert now / now_found == pytest.approx(1.0, abs=0.15)
    assert later / later_found == pytest.approx(1.0, abs=0.1)


@pytest.mark.soak
@pytest.mark.parametrize("told", [0.01, None])
@pytest.mark.parametrize("motion", [SAME, ALL])
@pytest.mark.parametrize(("first", "further"), [(30, 30), (30, 300), (100, 100), (100, 1000)])
@pytest.mark.parametrize("first_deg", [80, 20])
def test_forecast_errors_match_observed_over_many_arms(first, first_deg, further, motion, told):
    now, now_found, later, later_found = foretold_and_found(200, first, first_deg, further, motion, told)
    assert now / now_found == pytest.approx(1.0, abs=0.1)
    assert later / later_found == pytest.approx(1.0, abs=0.1)


def test_forecast_error_falls_and_best_motion_is_first():
    rng = np.random.default_rng(1)
    arm = rough_arm(rng)
    learner, q = learner_of(arm, rng, 50, 20)
    limits = np.full(6, LIMIT)
    region = random_q(rng, arm.kinds, 100, 80)
    motions = candidate_motions(q, -limits, limits, rng)
    forecast = expected_gain(ChainPosterior.of(learner), region, motions, (30, 300), rng)
    assert {motion.motion for motion in forecast.motions} == set(motions)
    assert all(forecast.now > motion.errors[0] > motion.errors[1] for motion in forecast.motions)
    last = [motion.errors[-1] for motion in forecast.motions]
    assert last == sorted(last)


@pytest.mark.parametrize("held", [1, 3])
def test_best_motion_moves_the_joint_never_moved(held):
    rng = np.random.default_rng(2)
    arm = rough_arm(rng)
    q = random_q(rng, arm.kinds, 200, 80)
    q[:, held] = 0.0
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(q, arm.real.positions(q) + 0.01 * rng.normal(size=(200, 3)), 0.01)
    limits = np.full(6, LIMIT)
    motions = candidate_motions(q, -limits, limits, rng, names=[f"j{k}" for k in range(6)])
    del motions[ALL]
    region = random_q(rng, arm.kinds, 100, 80)
    forecast = expected_gain(ChainPosterior.of(learner), region, motions, (50,), rng)
    assert forecast.motions[0].motion == f"j{held}"


def test_further_pairs_do_not_reduce_model_misfit():
    rng = np.random.default_rng(3)
    arm = rough_arm(rng)
    learner, q = learner_of(arm, rng, 200, told=0.006)
    limits = np.full(6, LIMIT)
    region = random_q(rng, arm.kinds, 100, 80)
    forecast = expected_gain(
        ChainPosterior.of(learner), region, candidate_motions(q, -limits, limits, rng), (100_000,), rng
    )
    # sqrt(10² − 6²) mm an axis, as a mean distance in three dimensions.
    assert forecast.least == pytest.approx(0.008 * np.sqrt(8.0 / np.pi), rel=0.1)
    assert all(motion.errors[0] == pytest.approx(forecast.least, rel=0.05) for motion in forecast.motions)


def test_data_suffice_when_no_motion_gains_a_tenth():
    rng = np.random.default_rng(4)
    arm = rough_arm(rng)
    limits = np.full(6, LIMIT)
    region = random_q(rng, arm.kinds, 100, 80)

    def forecast(pairs: int) -> Forecast:
        learner, q = learner_of(arm, rng, pairs)
        motions = candidate_motions(q, -limits, limits, rng)
        return expected_gain(ChainPosterior.of(learner), region, motions, (100,), rng)

    assert not forecast(30).is_enough()
    assert forecast(2000).is_enough()
    assert not forecast(2000).is_enough(share=0.001)


def test_same_motion_keeps_joint_spread_and_correlation():
    rng = np.random.default_rng(5)
    seen = rng.uniform(-1.0, 1.0, (300, 3)) * [0.3, 0.1, 0.0] + [0.5, 0.0, 0.2]
    seen[:, 1] += 0.5 * seen[:, 0]
    limits = np.full(3, 3.0)
    like = candidate_motions(seen, -limits, limits, rng, count=20_000)[SAME]
    np.testing.assert_allclose(like.mean(axis=0), seen.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(like.std(axis=0), seen.std(axis=0), atol=0.006)
    assert np.corrcoef(like[:, :2].T)[0, 1] == pytest.approx(np.corrcoef(seen[:, :2].T)[0, 1], abs=0.03)
    assert (like >= seen.min(axis=0)).all()
    assert (like <= seen.max(axis=0)).all()


def test_motion_moves_only_its_joints_over_full_range():
    rng = np.random.default_rng(6)
    seen = 0.1 * rng.normal(size=(50, 4))
    limits = np.full(4, 2.0)
    found = candidate_motions(seen, -limits, limits, rng, names="abcd", together=2)
    assert len(found) == 2 + 6
    spread = np.ptp(found["b and d"], axis=0)
    assert (spread[[1, 3]] > 3.8).all()
    assert (spread[[0, 2]] < 1.0).all()


def test_invalid_arguments_are_refused():
    rng = np.random.default_rng(7)
    arm = rough_arm(rng)
    learner, q = learner_of(arm, rng, 20)
    posterior, limits = ChainPosterior.of(learner), np.full(6, LIMIT)
    for refused in (
        lambda: expected_gain(posterior, q, {}, (10,), rng),
        lambda: expected_gain(posterior, q, {"none": q[:0]}, (10,), rng),
        lambda: expected_gain(posterior, q, {SAME: q}, (), rng),
        lambda: expected_gain(posterior, q, {SAME: q}, (10, 10), rng),
        lambda: expected_gain(posterior, q, {SAME: q}, (0, 10), rng),
        lambda: expected_gain(posterior, q, {SAME: q}, (10,), rng).error_after(SAME, 11),
        lambda: candidate_motions(q[:0], -limits, limits, rng),
        lambda: candidate_motions(q, limits, -limits, rng),
        lambda: candidate_motions(q, -limits, limits, rng, names=["one"]),
        lambda: candidate_motions(q, -limits, limits, rng, together=7),
        lambda: candidate_motions(q, -limits, limits, rng, count=0),
    ):
        with pytest.raises(SettingError):
            refused()
