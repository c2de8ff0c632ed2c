"""Selection of an arm's tolerances: the chain chosen, and the one to which further pairs are added."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from guided_arm import Scene, nominal_model

from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.model_bank import RIGID
from bodyschema.learning.regimes import Regimes
from bodyschema.learning.solvers.solver import Solved
from bodyschema.learning.solvers.tolerance_selection import Tolerances, best_tolerances
from kbmaps import ChainTolerances, RigidLearner

NOMINAL, SCENE = nominal_model(), Scene.draw(0, 40)
WIDE = ChainTolerances(axes=0.05, points=0.015, zeros=0.05, tool=0.03)
GOOD = replace(WIDE, axes=0.001, points=0.0005)


def belief_in(tolerances: ChainTolerances):
    learner = RigidLearner(NOMINAL.chain, tolerances)
    learner.learn(SCENE.q, SCENE.chain.positions(SCENE.q))
    return learner.belief


def test_the_drawing_is_not_held_to_where_it_is_improbable() -> None:
    wide = belief_in(WIDE)
    found = best_tolerances(wide, WIDE, [Tolerances(WIDE, 0.9), Tolerances(GOOD, 0.1)])
    np.testing.assert_allclose(found.mean, wide.mean)


def test_pairs_with_another_tool_are_added_to_what_is_believed_of_any_workmanship() -> None:
    eras = Regimes.at_nominal(NOMINAL, LearnerConfig(), itertools.count())
    era, wide = eras.present, belief_in(WIDE)
    assert era is not None
    narrow = wide.tightened(WIDE, GOOD)[0]
    era.begin_with(SCENE.q, np.array([pair.x for pair in SCENE.pairs]))
    kbmap = narrow.chain.to_kbmap(NOMINAL.bases)
    era.take(Solved(era.task_number, 40, RIGID, kbmap, narrow, wide=wide), kbmap, 40)
    eras.change_tool(era)
    assert eras.present is not None
    axes = slice(0, wide.parameters.zeros.start)
    np.testing.assert_allclose(eras.present.arm.chain.covariance[axes, axes], wide.covariance[axes, axes], atol=1e-12)
