from __future__ import annotations

import numpy as np
import pytest
from guided_arm import Scene, built_chain, near, nominal_model, path

import bodyschema.learning.solvers.solver as solver_module
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.model_bank import EXACT, RESIDUAL, RIGID, LearntModel
from bodyschema.learning.solvers.solver import DirectSolver, Task, fitted_belief
from kbmaps import ChainTolerances, RigidChain

NOMINAL = nominal_model()
TOLERANCES = ChainTolerances(axes=0.05, points=0.015, zeros=0.05, tool=0.03)
BELIEF = NOMINAL.belief(NOMINAL.chain, TOLERANCES)
TASK = Task(1, NOMINAL.prior, BELIEF)
SIGMA_M = 0.002
# A tenth of the solver's own numbers.
KEPT, FOLDED = 400, 200


def test_first_solution_uses_the_first_thirty_pairs() -> None:
    scene, solver = Scene.draw(0, 40), DirectSolver()
    solver.start(TASK)
    solver.learn(scene.q, scene.chain.positions(scene.q))
    solutions = solver.solutions()
    assert [(solved.name, solved.pairs) for solved in (next(solutions), next(solutions))] == [(RIGID, 30), (RIGID, 40)]


@pytest.fixture(scope="module")
def arm() -> RigidChain:
    return built_chain(np.random.default_rng(0))


@pytest.fixture(scope="module")
def seen_first() -> FloatArray:
    return path(np.random.default_rng(1), FOLDED)


@pytest.fixture(scope="module")
def after_a_long_rest(arm: RigidChain, seen_first: FloatArray) -> dict[str, LearntModel]:
    """Return solutions of a path whose pairs are deleted, and of an arm that hardly moved since."""
    rng, solver = np.random.default_rng(2), DirectSolver()
    q = np.vstack([seen_first, seen_first[-1] + rng.normal(0.0, 0.02, (KEPT + 1 - FOLDED, NOMINAL.joints))])
    solver.start(TASK)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver_module.BatchSettings, "kept", KEPT)
        patch.setattr(solver_module, "FOLDED", FOLDED)
        solver.learn(q, arm.positions(q) + SIGMA_M * rng.normal(size=(len(q), 3)))
        return {solved.name: solved.model for solved in solver.solutions() if solved.model is not None}


@pytest.mark.parametrize("name", [RIGID, RESIDUAL])
def test_knowledge_from_discarded_pairs_is_not_forgotten(
    name: str, arm: RigidChain, seen_first: FloatArray, after_a_long_rest: dict[str, LearntModel]
) -> None:
    q = near(np.random.default_rng(3), seen_first)
    miss = after_a_long_rest[name].predict(q) - arm.positions(q)
    assert np.linalg.norm(miss, axis=1).mean() < SIGMA_M


def test_pairs_outside_window_do_not_affect_exact_map(arm: RigidChain, monkeypatch) -> None:
    window, older = 200, 300
    monkeypatch.setattr(solver_module.BatchSettings, "window", window)
    q, solver = path(np.random.default_rng(5), older + window), DirectSolver()
    x = arm.positions(q)
    x[:older] += 0.1
    solver.start(Task(1, arm.to_kbmap(NOMINAL.bases), BELIEF, prior_stays=True))
    solver.learn(q, x)
    exact = next(solved.model for solved in solver.solutions() if solved.name == EXACT)
    assert exact is not None
    np.testing.assert_allclose(exact.predict(q), arm.positions(q), atol=1e-6)


def test_shared_neighbour_errors_widen_the_fitted_variance(arm: RigidChain) -> None:
    rng = np.random.default_rng(4)
    q = path(rng, 400)
    own = SIGMA_M * rng.normal(size=(400, 3))
    shared = np.repeat(own[::20], 20, axis=0)
    of_own, of_shared = (
        fitted_belief(BELIEF, q, arm.positions(q) + noise).predict_with_variance(q)[1].mean() for noise in (own, shared)
    )
    assert of_shared > 4.0 * of_own


def rigid_error_m(real: RigidChain, seed: int, tolerances: ChainTolerances | None) -> float:
    """Return the mean error of the solved chain near a path of 150 pairs with 20 mm of noise."""
    rng, solver = np.random.default_rng(seed), DirectSolver()
    q = path(rng, 150)
    solver.start(Task(1, NOMINAL.prior, BELIEF, tolerances=tolerances))
    solver.learn(q, real.positions(q) + 0.02 * rng.normal(size=(len(q), 3)))
    chain = next(solved.model for solved in solver.solutions() if solved.name == RIGID and solved.pairs == len(q))
    assert chain is not None
    solution_requested = near(rng, q)
    return float(np.linalg.norm(chain.predict(solution_requested) - real.positions(solution_requested), axis=1).mean())


def test_tolerance_selection_helps_on_a_nominal_arm() -> None:
    real = NOMINAL.chain.with_tool([0.02, -0.01, 0.03])
    told, wide = ([rigid_error_m(real, seed, each) for seed in range(8)] for each in (TOLERANCES, None))
    assert np.mean(told) < 0.7 * np.mean(wide)


def test_tolerance_selection_costs_nothing_on_inaccurate_arms() -> None:
    real = [built_chain(np.random.default_rng(seed), 3.0, 0.015) for seed in range(8)]
    told, wide = ([rigid_error_m(real[seed], seed, each) for seed in range(8)] for each in (TOLERANCES, None))
    assert np.mean(told) < 1.05 * np.mean(wide)
