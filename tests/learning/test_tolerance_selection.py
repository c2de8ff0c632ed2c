"""Selection of an arm's tolerances: the chain chosen, and the one to which further pairs are added."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from guided_arm import Scene, nominal_model

from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.model_bank import RIGID
from bodyschema.learning.nominal import chain_tolerances
from bodyschema.learning.regime_history import Regimes
from bodyschema.learning.solvers.solver import Solved, fitted_belief
from bodyschema.learning.solvers.tolerance_selection import Tolerances, best_tolerances, select_tolerances
from kbmaps import ChainTolerances, RigidLearner

NOMINAL, SCENE = nominal_model(), Scene.draw(0, 40)
WIDE = ChainTolerances(axes=0.05, points=0.015, zeros=0.05, tool=0.03)
GOOD = replace(WIDE, axes=0.001, points=0.0005)


def belief_in(tolerances: ChainTolerances):
    learner = RigidLearner(NOMINAL.chain, tolerances)
    learner.learn(SCENE.q, SCENE.chain.positions(SCENE.q))
    return learner.belief


def test_improbable_narrow_tolerances_leave_chain_unchanged() -> None:
    wide = belief_in(WIDE)
    found = best_tolerances(wide, WIDE, [Tolerances(WIDE, 0.9), Tolerances(GOOD, 0.1)])
    np.testing.assert_allclose(found.mean, wide.mean)


def test_tool_change_continues_from_the_wide_tolerance_belief() -> None:
    regimes = Regimes.initial(NOMINAL, LearnerConfig(), itertools.count())
    regime, wide = regimes.current, belief_in(WIDE)
    assert regime is not None
    narrow = wide.tightened(WIDE, GOOD)[0]
    regime.learn_former_outliers(SCENE.q, np.array([pair.x for pair in SCENE.pairs]))
    kbmap = narrow.chain.to_kbmap(NOMINAL.bases)
    regime.take(Solved(regime.task_number, 40, RIGID, kbmap, narrow, wide=wide), kbmap, 40)
    regimes.change_tool(regime)
    assert regimes.current is not None
    axes = slice(0, wide.parameters.zeros.start)
    np.testing.assert_allclose(
        regimes.current.arm.chain.covariance[axes, axes], wide.covariance[axes, axes], atol=1e-12
    )


def test_narrow_tolerances_do_not_move_well_determined_chain() -> None:
    """Along a tangent, the unknown pose and marker are moved farther than positions are linear in them."""
    nominal = nominal_model(pose_known=False, marker_known=False)
    tolerances = nominal.tolerances(chain_tolerances(LearnerConfig()))
    off = list[float]()
    for seed in range(6):
        scene = Scene.draw(seed, 400)
        q = np.random.default_rng(seed).uniform(-1.0, 1.0, scene.q.shape)
        x = scene.chain.positions(q) + 1e-5 * np.random.default_rng(seed).normal(size=(len(q), 3))
        wide = fitted_belief(nominal.belief(nominal.aligned_chain(q, x), chain_tolerances(LearnerConfig())), q, x)
        made = best_tolerances(wide, tolerances, select_tolerances(wide, tolerances, q))
        apart = made.predict(q) - scene.chain.positions(q)
        off.append(float(np.sqrt(np.square(apart).sum(axis=1).mean())))
        np.testing.assert_allclose(
            made.predict_with_variance(q)[1].mean(), wide.predict_with_variance(q)[1].mean(), rtol=0.5
        )
    assert max(off) < 1e-5
