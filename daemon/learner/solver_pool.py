"""Share one solver process between several robots: each has a seat, and they take turns by need."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from bodyschema.daemon.learner.solver_process import SolverLostError, SolverProcess
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.solvers.solver import Solved, Task


class SolverPool:
    """Pool that gives a process one robot's orders at a time. Single-threaded.

    A robot's orders wait here for its turn, because the process does not read while it solves.
    """

    def __init__(self, process: SolverProcess) -> None:
        self._process = process
        self._solvers: list[PooledSolver] = []
        self._active: PooledSolver | None = None
        self._turn = 0

    def new_solver(self) -> PooledSolver:
        """Add a robot, and return its solver."""
        new_solver = PooledSolver(self, self._process, len(self._solvers))
        self._solvers.append(new_solver)
        return new_solver

    def dispatch(self) -> None:
        """Collect the process's answers, and give the turn to the robot with the greatest need.

        Raises:
            SolverLostError: the process has ended; all seats are empty.
        """
        try:
            if self._active is not None and (solved := self._process.poll()) is not None:
                self._active.answers.append(solved)
                if solved.last:
                    self._active = None
            if self._active is None:
                self._start_next()
        except SolverLostError:
            self._active = None
            for solver in self._solvers:
                solver.clear()
            raise

    def _start_next(self) -> None:
        waiting = [solver for solver in self._solvers if solver.is_requested]
        if not waiting:
            return
        self._turn += 1
        solver = max(waiting, key=lambda solver: solver.urgency(self._turn))
        solver.submit(self._turn)
        self._active = solver


class PooledSolver:
    """A `Solver` of one robot, in a process shared with others."""

    def __init__(self, pool: SolverPool, process: SolverProcess, robot: int) -> None:
        self._pool, self._process, self._robot = pool, process, robot
        self._orders: deque[Callable[[], None]] = deque()
        self._pairs = self._new = self._last_turn = 0
        self.is_requested = False  # True if a solution is wanted that the process does not compute yet
        self.answers: deque[Solved] = deque()  # answers not fetched yet

    def start(self, task: Task) -> None:
        self.clear()
        self._orders.append(lambda: self._process.start(task, self._robot))

    def learn(
        self, q: FloatArray, x: FloatArray, cov: FloatArray | None = None, turns: FloatArray | None = None
    ) -> None:
        """Queue more pairs, as in `Solver`."""
        self._new += len(q)
        self._orders.append(lambda: self._process.learn(q, x, cov, turns, self._robot))

    def solve(self) -> None:
        """Request the solution for all pairs so far, for this robot's next turn."""
        self.is_requested = True

    def poll(self) -> Solved | None:
        self._pool.dispatch()
        return self.answers.popleft() if self.answers else None

    def urgency(self, turn: int) -> float:
        """Return the urgency: the relative growth of the pairs, times the number of turns of others since."""
        return (turn - self._last_turn) * self._new / max(self._pairs, 1)

    def submit(self, turn: int) -> None:
        """Send all queued orders to the process, and request a solution."""
        while self._orders:
            self._orders[0]()
            self._orders.popleft()
        self._process.solve(self._robot)
        self._pairs, self._new, self._last_turn, self.is_requested = self._pairs + self._new, 0, turn, False

    def clear(self) -> None:
        """Discard all orders and answers."""
        self._orders.clear()
        self.answers.clear()
        self._pairs = self._new = 0
        self.is_requested = False
