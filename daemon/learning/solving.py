"""What a solver is given, and when it is asked."""

from __future__ import annotations

from bodyschema.interfaces.records import FloatArray

from .solver import Solved, Solver, Task

# While pairs are few, a solution is worth renewing, and cheap, when so many more have come as a share of them.
GROWTH = 0.1


class Solving:
    """Keeps one solver up to date. For the background thread alone.

    Nothing is sent while the solver works: in a process of its own it does not listen meanwhile, and the sender would
    wait for it with everything else that the thread has to do.
    """

    def __init__(self, solver: Solver, solve_every: int) -> None:
        self._solver, self._every = solver, solve_every
        self.restart()

    @property
    def fed(self) -> int:
        """How many pairs of the present task the solver has."""
        return self._fed

    @property
    def busy(self) -> bool:
        """Whether it was asked and has not answered."""
        return self._busy

    @property
    def due(self) -> bool:
        """Whether it is time to ask."""
        enough = min(self._every, max(GROWTH * self._solved_at, 1.0))
        return self._fed > 0 and (self._soon or self._fed - self._solved_at >= enough)

    def works_on(self, task: int) -> bool:
        """Whether it was given pairs of this task, and of no other since."""
        return self._task == task and self._fed > 0

    def has_solved(self, task: int, pairs: int) -> bool:
        """Whether so many pairs of the task were given, asked for and answered."""
        return self._task == task and not self._busy and self._fed == self._solved_at == pairs

    def restart(self) -> None:
        """The solver has lost everything."""
        self._task: int | None = None
        self._fed = self._solved_at = 0
        self._busy = self._soon = False

    def solve_soon(self) -> None:
        """Ask although fewer pairs than usual are new."""
        self._soon = self._soon or self._fed > self._solved_at or self._task is None

    def begin(self, task: Task) -> bool:
        """Tell the solver of a new task; False when it knows it."""
        if task.number == self._task:
            return False
        self._solver.start(task)
        self._fed = self._solved_at = 0
        self._task = task.number
        return True

    def feed(self, q: FloatArray, x: FloatArray, fed: int, turns: FloatArray | None = None) -> None:
        """More pairs, q (n, d) [rad] and x (n, 3) [m]; with them the solver has `fed`.

        Args:
            turns: their orientations, quaternions (n, 4), NaN where a pair has none; None where no pair has any.
        """
        self._solver.learn(q, x, turns)
        self._fed = fed

    def ask(self) -> None:
        """Ask for the solutions of all pairs so far."""
        self._solver.solve()
        self._busy, self._soon, self._solved_at = True, False, self._fed

    def poll(self) -> Solved | None:
        """The next answer when it has come, without waiting."""
        solved = self._solver.poll()
        if solved is not None:
            self._busy = not solved.last
        return solved
