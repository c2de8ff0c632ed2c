from __future__ import annotations

import sys

import numpy as np
import pytest
from guided_arm import JOINTS, nominal_model

from bodyschema.daemon.learner import solver_process
from bodyschema.daemon.learner.solver_process import SolverLostError
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.model_bank import RIGID
from bodyschema.learning.solvers.solver import Solved, SolverClient, Task
from kbmaps import ChainTolerances

NOMINAL = nominal_model()
PRIOR = NOMINAL.prior
TASK = Task(1, PRIOR, NOMINAL.belief(NOMINAL.chain, ChainTolerances()))
Q, X = np.zeros((10, JOINTS)), np.zeros((10, 3))


class ScriptedSolver:
    """A solver that records its tasks and answers at the test's command."""

    def __init__(self) -> None:
        self.told: list[object] = []
        self.answer: Solved | None = None

    def start(self, task: Task) -> None:
        self.told.append(("start", task.number))

    def learn(
        self, q: FloatArray, x: FloatArray, cov: FloatArray | None = None, turns: FloatArray | None = None
    ) -> None:
        self.told.append(("learn", len(q)))

    def solve(self) -> None:
        self.told.append("solve")

    def poll(self) -> Solved | None:
        answer, self.answer = self.answer, None
        return answer


@pytest.fixture
def solver() -> ScriptedSolver:
    return ScriptedSolver()


@pytest.fixture
def solving(solver: ScriptedSolver) -> SolverClient:
    solving = SolverClient(solver, solve_every=25)
    solving.begin(TASK)
    return solving


def test_new_task_is_sent_once(solver: ScriptedSolver, solving: SolverClient) -> None:
    assert not solving.begin(TASK)
    assert solver.told == [("start", 1)]


@pytest.mark.parametrize(("solved_at", "not_yet", "due_at"), [(50, 54, 55), (1000, 1024, 1025)])
def test_solver_interval_is_tenth_up_to_configured_limit(
    solver: ScriptedSolver, solving: SolverClient, solved_at: int, not_yet: int, due_at: int
) -> None:
    solving.feed(Q, X, solved_at)
    solving.request_solution()
    solver.answer = Solved(1, solved_at, RIGID, PRIOR)
    solving.poll()
    solving.feed(Q, X, not_yet)
    early = solving.due
    solving.feed(Q, X, due_at)
    assert (early, solving.due) == (False, True)


def test_no_solution_is_due_without_new_pairs(solver: ScriptedSolver, solving: SolverClient) -> None:
    solving.feed(Q, X, 25)
    solving.request_solution()
    solver.answer = Solved(1, 25, RIGID, PRIOR)
    solving.poll()
    solving.solve_soon()
    assert not solving.due


def test_it_is_busy_until_the_last_answer(solver: ScriptedSolver, solving: SolverClient) -> None:
    solving.feed(Q, X, 25)
    solving.request_solution()
    busy = []
    for last in (False, True):
        solver.answer = Solved(1, 25, RIGID, PRIOR, last=last)
        solving.poll()
        busy.append(solving.busy)
    assert busy == [True, False]


def test_solver_is_busy_from_request_to_answer(solver: ScriptedSolver, solving: SolverClient) -> None:
    solving.feed(Q, X, 25)
    solving.request_solution()
    waiting = solving.busy, solving.poll(), solving.busy
    solver.answer = Solved(1, 25, RIGID, PRIOR)
    assert solving.poll() is not None
    assert (waiting, solving.busy) == ((True, None, True), False)


def test_restarted_solver_is_fed_from_the_beginning(solver: ScriptedSolver, solving: SolverClient) -> None:
    solving.feed(Q, X, 10)
    solving.restart()
    assert solving.begin(TASK)
    assert (solver.told[-1], solving.fed) == (("start", 1), 0)


def test_a_solver_that_hangs_is_replaced(monkeypatch) -> None:
    program = (sys.executable, "-S", "-c", "import signal; signal.pause()")
    monkeypatch.setattr(solver_process, "module_command", lambda _: program)
    monkeypatch.setattr(solver_process._Settings, "hung_after_s", 0.001)
    with solver_process.SolverProcess() as process:
        process.start(TASK)
        process.solve()
        with pytest.raises(SolverLostError, match="started again"):
            list(iter(process.poll, ()))
        assert process.pid is None


def test_solver_that_reads_nothing_is_replaced(monkeypatch) -> None:
    monkeypatch.setattr(solver_process, "module_command", lambda _: ("sleep", "60"))
    monkeypatch.setattr(solver_process._Settings, "reads_within_s", 0.0)
    monkeypatch.setattr(solver_process._Settings, "hung_after_s", 0.0)
    with solver_process.SolverProcess() as process:
        process.start(TASK)
        process.learn(np.zeros((10_000, 3)), np.zeros((10_000, 3)))
        process.solve()
        with pytest.raises(SolverLostError, match="started again"):
            list(iter(process.poll, ()))


def test_polling_does_not_wait_for_blocked_solver(monkeypatch) -> None:
    monkeypatch.setattr(solver_process, "module_command", lambda _: ("sleep", "60"))
    monkeypatch.setattr(solver_process._Settings, "reads_within_s", 0.0)
    with solver_process.SolverProcess() as process:
        process.start(TASK)
        process.learn(np.zeros((10_000, 3)), np.zeros((10_000, 3)))
        # A poll that waited would reach the time limit.
        monkeypatch.setattr(solver_process._Settings, "reads_within_s", 3600.0)
        assert process.poll() is None


def test_solver_with_unreadable_cpu_clock_is_kept(monkeypatch) -> None:
    def unknown(clock: int) -> float:
        raise OSError(22, "Invalid argument")

    monkeypatch.setattr(solver_process, "module_command", lambda _: ("sleep", "60"))
    monkeypatch.setattr(solver_process._Settings, "hung_after_s", 0.0)
    monkeypatch.setattr(solver_process.time, "clock_gettime", unknown)
    with solver_process.SolverProcess() as process:
        process.start(TASK)
        process.solve()
        assert [process.poll(), process.poll()] == [None, None]
        assert process.pid is not None
