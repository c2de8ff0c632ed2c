from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import random_q
from rough_arms import ROUGH, rough_arm

from kbmaps import (
    ChainPosterior,
    ChainTolerances,
    ExperimentDesign,
    RigidLearner,
    SettingError,
    ShapeError,
    next_pose,
    next_poses,
)
from kbmaps.planning.design import mean_distances

seeds = st.integers(0, 2**32 - 1)
# An arm at any pose within 3 m.
LOST = ChainTolerances(ROUGH.axes, ROUGH.points, tool=ROUGH.tool, base_rotation=3.0, base_translation=3.0)


class ContourSpectrum:
    """A linear model of two joints: x = B(q) w with a few sines, weights w from N(0, root rootᵀ)."""

    joints = 2

    def __init__(self, rng, noise=0.1, floor=0.0):
        self.noise, self.floor = noise, floor
        self.root = rng.normal(size=(12, 12))
        self._mix = rng.normal(size=(4, 2))

    def features(self, q):
        basis = np.sin(np.asarray(q) @ self._mix.T + np.arange(4))
        return np.einsum("nk,ij->nijk", basis, np.eye(3)).reshape(len(basis), 3, 12)

    def roots(self, q):
        return self.features(q) @ self.root

    def covariances_after(self, q, region):
        """Return the textbook covariance (Σ⁻¹ + BᵀB/σ²)⁻¹ of the weights themselves."""
        seen = self.features(q).reshape(-1, 12)
        covariance = np.linalg.inv(np.linalg.inv(self.root @ self.root.T) + seen.T @ seen / self.noise**2)
        shown = self.features(region)
        return shown @ covariance @ shown.transpose(0, 2, 1) + self.floor**2 * np.eye(3)


def planted(seed, floor=0.0):
    rng = np.random.default_rng(seed)
    return ContourSpectrum(rng, floor=floor), rng.uniform(-2, 2, (20, 2)), rng.uniform(-2, 2, (15, 2))


@given(seed=seeds, floor=st.sampled_from([0.0, 0.2]))
def test_predicted_error_equals_posterior_error_with_those_pairs(seed, floor):
    model, region, q = planted(seed, floor)
    design = ExperimentDesign(model, region)
    wanted = mean_distances(model.covariances_after(q, region)).mean()
    assert design.error_after(model.roots(q)) == pytest.approx(wanted, rel=1e-5)
    design.add(model.roots(q))
    assert design.error == pytest.approx(wanted, rel=1e-5)


@given(seed=seeds)
def test_beginning_with_some_pairs_forgets_all_others(seed):
    model, region, q = planted(seed)
    design, fresh = ExperimentDesign(model, region), ExperimentDesign(model, region)
    design.add(model.roots(q))
    design.begin_with(model.roots(q[:5]))
    fresh.add(model.roots(q[:5]))
    assert design.error == fresh.error


@given(seed=seeds, floor=st.sampled_from([0.0, 0.2]))
def test_rms_error_falls_by_at_least_the_gain(seed, floor):
    model, region, q = planted(seed, floor)

    def rms(covariances):
        return np.sqrt(np.trace(covariances, axis1=1, axis2=2)).mean()

    before = rms(model.covariances_after(q[:0], region))
    falls = [before - rms(model.covariances_after(q[k : k + 1], region)) for k in range(len(q))]
    gains = ExperimentDesign(model, region).gains(model.roots(q))
    assert (gains > 0.0).all()
    assert (gains <= np.array(falls) * (1.0 + 1e-6)).all()


@given(seed=seeds)
def test_gains_match_exact_error_reduction_to_first_order(seed):
    """With large noise a pair changes little and the linearisation is exact; with more, rounding dominates."""
    model, region, q = planted(seed)
    model.noise = 1e3
    before = np.sqrt(np.trace(model.covariances_after(q[:0], region), axis1=1, axis2=2)).mean()
    gains = ExperimentDesign(model, region).gains(model.roots(q))
    after = [np.trace(model.covariances_after(q[k : k + 1], region), axis1=1, axis2=2) for k in range(len(q))]
    falls = before - np.sqrt(after).mean(axis=1)
    np.testing.assert_allclose(gains, falls, rtol=1e-2, atol=1e-12 * before)


def test_next_pose_is_candidate_with_greatest_gain():
    model, region, q = planted(1)
    gains = ExperimentDesign(model, region).gains(model.roots(q))
    np.testing.assert_array_equal(next_pose(model, region, q), q[gains.argmax()])


def test_often_measured_pose_is_not_chosen_again():
    rng = np.random.default_rng(2)
    arm = rough_arm(rng)
    often, other = random_q(rng, arm.kinds, 2, 80)
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(np.tile(often, (30, 1)), arm.real.positions(often) + 0.01 * rng.normal(size=(30, 3)), 0.01)
    posterior = ChainPosterior.of(learner)
    np.testing.assert_array_equal(next_pose(posterior, [other, often], [often, other]), other)


def test_plan_from_vague_belief_stays_within_limits():
    rng = np.random.default_rng(4)
    arm = rough_arm(rng, "RRRRR", LOST)
    learner = RigidLearner(arm.nominal, LOST)
    learner.learn(*arm.pairs(rng, 1), 1e-8)
    limits = np.full(5, np.radians(80.0))
    candidates = random_q(rng, arm.kinds, 30, 80)
    plan = next_poses(ChainPosterior.of(learner), candidates, candidates, 12, limits=(-limits, limits))
    assert (np.abs(plan) <= limits + 1e-12).all()


def test_no_candidate_is_taken_twice():
    model, region, q = planted(3)
    chosen = next_poses(model, region, q, len(q))
    assert len(np.unique(chosen, axis=0)) == len(q)


@given(seed=seeds)
def test_plan_stays_within_limits_and_beats_greedy_candidates(seed):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng)
    limits = np.full(6, np.radians(80.0))
    learner = RigidLearner(arm.nominal, ROUGH)
    learner.learn(*arm.pairs(rng, 10, 0.01, reach_deg=20), 0.01)
    posterior = ChainPosterior.of(learner)
    region, candidates = random_q(rng, arm.kinds, 100, 80), random_q(rng, arm.kinds, 50, 80)
    greedy, plan = (next_poses(posterior, region, candidates, 6, limits=bounds) for bounds in (None, (-limits, limits)))
    assert (np.abs(plan) <= limits + 1e-12).all()
    design = ExperimentDesign(posterior, region)
    assert design.error_after(posterior.roots(plan)) < design.error_after(posterior.roots(greedy))


@given(seed=seeds)
def test_mean_distances_match_sampling_within_four_percent(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-2, 2, 3)
    lengths = np.linalg.norm(rng.normal(size=(200_000, 3)) @ root.T, axis=1)
    assert mean_distances((root @ root.T)[None])[0] == pytest.approx(lengths.mean(), rel=0.035)


def test_mean_distances_are_exact_for_line_and_ball():
    one, ball = np.diag([0.0, 4.0, 0.0]), 4.0 * np.eye(3)
    wanted = [2.0 * np.sqrt(2.0 / np.pi), 4.0 * np.sqrt(2.0 / np.pi), 0.0]
    np.testing.assert_allclose(mean_distances(np.stack([one, ball, 0.0 * one])), wanted, rtol=1e-12)


def test_invalid_arguments_are_refused():
    model, region, q = planted(6)
    with pytest.raises(ShapeError):
        ExperimentDesign(model, region[:, :1])
    for refused in (
        lambda: ExperimentDesign(model, region[:0]),
        lambda: next_poses(model, region, q, 0),
        lambda: next_poses(model, region, q, len(q) + 1),
    ):
        with pytest.raises(SettingError):
            refused()


def test_chosen_poses_teach_more_than_random_ones():
    """Compare the learner's true errors over arms that were not used for the choice."""
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        arm = rough_arm(rng)
        limits = np.full(6, np.radians(80.0))
        learners = {way: RigidLearner(arm.nominal, ROUGH) for way in ("random", "chosen")}
        region = random_q(rng, arm.kinds, 100, 80)
        posterior = ChainPosterior.of(learners["chosen"], noise=0.01)
        planned = next_poses(posterior, region, random_q(rng, arm.kinds, 100, 80), 12, limits=(-limits, limits))
        for way, q in (("random", random_q(rng, arm.kinds, 12, 80)), ("chosen", planned)):
            learners[way].learn(q, arm.real.positions(q) + 0.01 * rng.normal(size=(12, 3)), 0.01)
        errors.append([arm.error(learner, rng) for learner in learners.values()])
    by_random, by_choice = np.mean(errors, axis=0)
    assert by_choice < 0.85 * by_random
