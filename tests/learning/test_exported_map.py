"""The map exported while the current model is not a map: the best map is used."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from guided_arm import Scene, make_pair, nominal_model

from bodyschema.learning.changes.known_arm import KnownArm
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.model_bank import EXACT, PRIOR, RESIDUAL, RIGID, LearntModel
from bodyschema.learning.regime import Regime
from bodyschema.learning.solvers.solver import Solved, fitted_residual
from bodyschema.learning.uncertainty import UncertaintyTracker
from kbmaps import ChainTolerances, KBMap

NOMINAL = nominal_model()
TOLERANCES = ChainTolerances(axes=0.05, points=0.015, zeros=0.05, tool=0.03)
BELIEF = NOMINAL.belief(NOMINAL.chain, TOLERANCES)
SCENE = Scene.draw(0, 60, sigma_m=1e-4)
X = np.array([pair.x for pair in SCENE.pairs])


def map_off_by(metres: float) -> KBMap:
    """Return the arm's map with the marker this far from its true position."""
    return SCENE.chain.with_tool([metres, 0.0, 0.0]).to_kbmap(NOMINAL.bases)


def beside(regime: Regime) -> str:
    """Return the name of the published map."""
    return next(name for name, kbmap in regime.models.maps.items() if kbmap is regime.map)


def take(regime: Regime, name: str, model: LearntModel) -> None:
    """Give the regime a solution of all pairs up to now."""
    pairs = regime.memory.count
    regime.request_solution()
    regime.take(Solved(regime.task_number, pairs, name, model), model, pairs)


def learn(regime: Regime, part: slice) -> None:
    for pair in SCENE.pairs[part]:
        regime.learn(pair)


@pytest.fixture
def regime() -> Regime:
    """Return a regime with a chain and residual models; the rigid chain's map is the best of the maps."""
    arm = KnownArm(BELIEF, TOLERANCES)
    regime = Regime(NOMINAL.prior, arm, UncertaintyTracker(NOMINAL.bases, 0.1), LearnerConfig(), itertools.count())
    learn(regime, slice(0, 20))
    residual = fitted_residual(BELIEF, SCENE.q, X)
    assert residual is not None
    take(regime, RIGID, map_off_by(0.004))
    take(regime, RESIDUAL, residual)
    learn(regime, slice(20, 40))
    return regime


def test_best_map_is_exported_while_residual_model_answers(regime: Regime) -> None:
    assert (regime.answering, beside(regime)) == (RESIDUAL, RIGID)


def test_it_becomes_another_one_when_that_predicts_better(regime: Regime) -> None:
    take(regime, EXACT, map_off_by(0.001))
    learn(regime, slice(40, 60))
    assert (regime.answering, beside(regime)) == (RESIDUAL, EXACT)


def test_fitted_prior_is_exported_after_comparison_pairs_removed(regime: Regime) -> None:
    old_tool = make_pair(41, SCENE.q[0], X[0] + 0.2)
    regime.learn_former_outliers(old_tool.q[None], old_tool.x[None])
    fitted = map_off_by(0.0)
    doubted = regime.drop_outliers(fitted)
    regime.change_prior(fitted)
    assert (doubted, beside(regime)) == (1, PRIOR)
