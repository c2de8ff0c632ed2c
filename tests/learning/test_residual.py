"""An arm that sags: the chain with residual is published, survives a restart, and follows a tool change."""

from __future__ import annotations

import time

import numpy as np
import pytest
from guided_arm import NOW_AND_THEN, built_chain, make_pair, near, new_learning, nominal_model, path, teach

from bodyschema.daemon.learner.solver_process import SolverProcess
from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.learning.model_bank import RESIDUAL, LearntModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver, Task
from kbmaps import ChainTolerances, KBMap, ResidualModel, RigidChain

SIGMA_M = 0.002
DOWN = np.array([0.1, 0.2, -0.97])
TOOL = np.array([0.1, 0.2, -0.1])
PAIRS = 200


class SaggingArm:
    """Joints that yield by some degrees under a weight where the marker was at first."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.chain = built_chain(self.rng)
        self.q = path(self.rng, PAIRS + 60)

    def positions(self, q: FloatArray, marker: RigidChain | None = None) -> FloatArray:
        torques = np.einsum("nij,i->nj", self.chain.jacobian(q), DOWN)
        return (marker or self.chain).positions(q + 0.5 * torques)

    def pairs(self, part: slice, marker: RigidChain | None = None) -> list[Pair]:
        x = self.positions(self.q[part], marker)
        noise = SIGMA_M * self.rng.normal(size=x.shape)
        return [make_pair(part.start + k + 1, self.q[part][k], x[k] + noise[k], SIGMA_M) for k in range(len(x))]

    def error_m(self, model: LearntModel, marker: RigidChain | None = None) -> float:
        q = near(np.random.default_rng(0), self.q[:PAIRS])
        return float(np.linalg.norm(model.predict(q) - self.positions(q, marker), axis=1).mean())


@pytest.fixture(scope="module")
def arm() -> SaggingArm:
    return SaggingArm(0)


@pytest.fixture(scope="module")
def taught(arm: SaggingArm) -> OnlineLearner:
    learning = new_learning()
    teach(learning, arm.pairs(slice(0, PAIRS)), every=NOW_AND_THEN)
    return learning


def test_it_answers_for_an_arm_that_sags(arm: SaggingArm, taught: OnlineLearner) -> None:
    assert taught.snapshot.answering == RESIDUAL
    snapshot = taught.snapshot
    assert arm.error_m(snapshot.require_model()) < 0.7 * arm.error_m(snapshot.require_map())


def test_that_it_sags_is_no_change(taught: OnlineLearner) -> None:
    assert taught.counters.changes == 0


def test_its_claim_holds_near_the_path(arm: SaggingArm, taught: OnlineLearner) -> None:
    q = near(np.random.default_rng(1), arm.q[:PAIRS])
    prediction = taught.snapshot.predict(q)
    ratios = np.abs(prediction.x - arm.positions(q)) / prediction.sigma
    assert (ratios < 2.0).mean() > 0.9


def test_residual_snapshot_also_provides_a_map(taught: OnlineLearner) -> None:
    snapshot = taught.snapshot
    assert isinstance(snapshot.require_model(), ResidualModel)
    assert isinstance(snapshot.require_map(), KBMap)
    assert snapshot.digest == snapshot.require_model().digest != snapshot.require_map().digest


def test_restored_learner_predicts_with_same_residual_model(arm: SaggingArm, taught: OnlineLearner) -> None:
    restored = new_learning()
    restored.restore(taught.state())
    assert restored.snapshot.digest == taught.snapshot.digest
    one, other = (learning.snapshot.predict(arm.q) for learning in (taught, restored))
    np.testing.assert_array_equal(one.x, other.x)
    np.testing.assert_allclose(one.sigma, other.sigma, rtol=1e-9)


def test_a_restored_learner_publishes_the_same_map(taught: OnlineLearner) -> None:
    restored = new_learning()
    restored.restore(taught.state())
    assert restored.snapshot.require_map().digest == taught.snapshot.require_map().digest


@pytest.mark.soak
def test_learnt_compliance_survives_a_tool_change(arm: SaggingArm, taught: OnlineLearner) -> None:
    learning = new_learning()
    learning.restore(taught.state())
    learning.tool_changed()
    marker = arm.chain.with_tool(TOOL)
    teach(learning, arm.pairs(slice(PAIRS, PAIRS + 60), marker), every=10)
    assert learning.snapshot.answering == RESIDUAL
    snapshot = learning.snapshot
    assert arm.error_m(snapshot.require_model(), marker) < 0.6 * arm.error_m(snapshot.require_map(), marker)


def test_another_tool_is_found_while_it_answers(arm: SaggingArm, taught: OnlineLearner) -> None:
    learning = new_learning()
    learning.restore(taught.state())
    teach(learning, arm.pairs(slice(PAIRS, PAIRS + 10), arm.chain.with_tool(TOOL)))
    assert learning.counters.changes == taught.counters.changes + 1


@pytest.mark.soak
def test_solver_process_gives_same_solution_as_direct_solver(arm: SaggingArm) -> None:
    nominal = nominal_model()
    tolerances = ChainTolerances(axes=0.05, points=0.015, tool=0.03)
    task = Task(1, nominal.prior, nominal.belief(nominal.chain, tolerances))
    q = arm.q[:60]
    found: list[str] = []
    with SolverProcess() as process:
        direct = DirectSolver()
        for solver in (direct, process):
            solver.start(task)
            solver.learn(q, arm.positions(q))
            solver.solve()
            last = False
            while not last:
                solved = solver.poll()
                if solved is not None and solved.name == RESIDUAL:
                    assert solved.belief is solved.model
                    found.append(solved.model.digest)
                last = solved is not None and solved.last
                if solved is None:
                    time.sleep(0.005)  # leave the processor to the solver's process
    assert found[0] == found[1]
