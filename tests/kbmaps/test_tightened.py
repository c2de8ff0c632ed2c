"""Beliefs whose tolerances are narrowed afterwards."""

from __future__ import annotations

import numpy as np
import pytest

from kbmaps import ChainBelief, ChainParameters, ChainTolerances, RigidChain, RigidLearner, SettingError

WIDE = ChainTolerances(axes=0.02, points=0.01, zeros=0.02, tool=0.02)
NARROW = ChainTolerances(axes=0.005, points=0.002, zeros=0.02, tool=0.02)


def arm() -> RigidChain:
    fixed = np.tile(np.eye(4), (4, 1, 1))
    fixed[1:, :3, 3] = [(0.3, 0.0, 0.0), (0.0, 0.2, 0.0), (0.1, 0.0, 0.1)]
    return RigidChain(fixed, [[0, 0, 1], [0, 1, 0], [1, 0, 0]], [False] * 3)


def test_tightened_belief_without_pairs_equals_narrow_prior() -> None:
    parameters = ChainParameters(arm())
    belief, evidence = ChainBelief.from_tolerances(parameters, WIDE).tightened(WIDE, NARROW)
    expected = ChainBelief.from_tolerances(parameters, NARROW).covariance
    np.testing.assert_allclose(belief.covariance, expected, atol=1e-12)
    assert evidence == pytest.approx(0.0, abs=1e-9)


def test_tightened_belief_with_pairs_matches_narrow_learner() -> None:
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.5, 1.5, (40, 3))
    x = arm().positions(q) + 1e-3 * rng.normal(size=(40, 3))
    learners = [RigidLearner(arm(), tolerances) for tolerances in (WIDE, NARROW)]
    for learner in learners:
        learner.learn(q, x, 1e-3)
    belief, evidence = learners[0].belief.tightened(WIDE, NARROW)
    std = np.sqrt(np.diag(learners[1].covariance))
    assert (np.abs(belief.mean - learners[1].change) <= 0.1 * std + 1e-12).all()
    np.testing.assert_allclose(np.sqrt(np.diag(belief.covariance)), std, rtol=0.05, atol=1e-12)
    assert evidence == pytest.approx(learners[1].log_evidence - learners[0].log_evidence, abs=0.5)


def test_tolerances_cannot_be_made_wider() -> None:
    with pytest.raises(SettingError, match="only be made narrower"):
        ChainBelief.from_tolerances(ChainParameters(arm()), NARROW).tightened(NARROW, WIDE)
