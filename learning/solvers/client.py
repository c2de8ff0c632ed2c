"""Client of a solver: sends it pairs, and schedules its solutions."""

from __future__ import annotations

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.solvers.solver import Solved, Solver, Task

# While pairs are few, a solution is cheap, and renewed after this growth of their number.
GROWTH = 0.1


class SolverClient:
    """Keeps one solver up to date. For the background thread alone.

    Nothing is sent while the solver works: in a process of its own it does not read meanwhile, and the thread would
    block on the send.
    """

    def __init__(self, solver: Solver, solve_every: int) -> None:
        self._solver, self._every = solver, solve_every
        self.restart()

    @property
    def fed(self) -> int:
        """Number of pairs of the current task that the solver has."""
        return self._fed

    @property
    def busy(self) -> bool:
        """True if it was asked and has not answered."""
        return self._busy

    @property
    def due(self) -> bool:
        """True if it is time to ask."""
        enough = min(self._every, max(GROWTH * self._solved_at, 1.0))
        return self._fed > 0 and (self._soon or self._fed - self._solved_at >= enough)

    def works_on(self, task: int) -> bool:
        """Return True if it has pairs of this task, and of no other since."""
        return self._task == task and self._fed > 0

    def has_solved(self, task: int, pairs: int) -> bool:
        """Return True if this many pairs of the task were given, asked for and answered."""
        return self._task == task and not self._busy and self._fed == self._solved_at == pairs

    def restart(self) -> None:
        """Reset after the solver has lost everything."""
        self._task: int | None = None
        self._fed = self._solved_at = 0
        self._busy = self._soon = False

    def solve_soon(self) -> None:
        """Ask even though fewer pairs than usual are new."""
        self._soon = self._soon or self._fed > self._solved_at or self._task is None

    def begin(self, task: Task) -> bool:
        """Start a new task on the solver; return False if it already has this one."""
        if task.number == self._task:
            return False
        self._solver.start(task)
        self._fed = self._solved_at = 0
        self._task = task.number
        return True

    def feed(self, q: FloatArray, x: FloatArray, fed: int, turns: FloatArray | None = None) -> None:
        """Send pairs, q (n, d) [rad] and x (n, 3) [m]; with them the solver has `fed`.

        Args:
            q: joint values.
            x: positions.
            fed: number of the task's pairs that the solver then has.
            turns: their orientations, quaternions (n, 4), NaN where a pair has none; None where no pair has any.
        """
        self._solver.learn(q, x, turns)
        self._fed = fed

    def ask(self) -> None:
        """Request the solutions of all pairs so far."""
        self._solver.solve()
        self._busy, self._soon, self._solved_at = True, False, self._fed

    def poll(self) -> Solved | None:
        """Return the next answer if there is one, without waiting."""
        solved = self._solver.poll()
        if solved is not None:
            self._busy = not solved.last
        return solved
