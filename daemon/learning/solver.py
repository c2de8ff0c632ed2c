"""The exact member: least squares over all pairs since the tool was last changed, at the prior elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from interfaces.records import FloatArray
from kbmaps import ExactLearner, KBMap, SettingError, blockwise_precision, follow_a_path

# Memory and time grow with the square and the cube of the control points: 3^7 take 77 MB and 0.2 s.
LARGEST_NET = 2187
# The prior's precision is looked for anew when the pairs have grown by this factor.
RETUNE = 1.25
# So many of the newest pairs are kept to look for it.
KEPT = 5000


@dataclass(frozen=True)
class Solved:
    """What a solver found.

    Attributes:
        task: number of the task it belongs to.
        pairs: how many pairs it is the solution of.
        map: None when these pairs have no solution.
    """

    task: int
    pairs: int
    map: KBMap | None


class ExactSolver(Protocol):
    """Solves one task at a time; a task is a prior and the pairs that came since `start`."""

    def start(self, task: int, prior: KBMap) -> None:
        """Forget all pairs and begin a new task."""
        ...

    def rebase(self, prior: KBMap) -> None:
        """Another prior for the same pairs."""
        ...

    def learn(self, q: FloatArray, x: FloatArray) -> None:
        """More pairs, q (n, d) [rad] and x (n, 3) [m]."""
        ...

    def solve(self) -> None:
        """Ask for the solution of all pairs so far; `poll` gives it, perhaps later."""
        ...

    def poll(self) -> Solved | None:
        """The answer to a `solve` that has not been given yet, without waiting."""
        ...


class DirectSolver:
    """Solves at once, in the caller's thread."""

    def __init__(self) -> None:
        self._task = 0
        self._learner: ExactLearner | None = None
        self._precision: float | None = None
        self._tuned_at = 0
        self._solved: Solved | None = None
        self._q = self._x = np.empty((0, 0))

    def start(self, task: int, prior: KBMap) -> None:
        """Forget all pairs and begin a new task."""
        self._task, self._learner = task, ExactLearner(prior)
        self._precision, self._tuned_at, self._solved = None, 0, None
        self._q, self._x = np.empty((0, prior.joints)), np.empty((0, 3))

    def rebase(self, prior: KBMap) -> None:
        """Another prior for the same pairs."""
        self._started.rebase(prior)
        self._precision = None

    def learn(self, q: FloatArray, x: FloatArray) -> None:
        """More pairs, q (n, d) [rad] and x (n, 3) [m]."""
        self._started.learn(q, x)
        self._q, self._x = np.vstack([self._q, q])[-KEPT:], np.vstack([self._x, x])[-KEPT:]

    def solve(self) -> None:
        """Solve; the prior's precision is looked for when the pairs have grown.

        The evidence finds it where pairs are apart. On a guided path neighbours share their errors, and it would take
        those for shape: there, left-out blocks speak.
        """
        learner = self._started
        retune = self._precision is None or learner.pairs >= RETUNE * self._tuned_at
        try:
            solution = learner.solve(self._sought_precision(learner.prior) if retune else self._precision)
        except SettingError:
            # The precision was lost in rounding: without a solution the others go on answering.
            self._precision = None
            self._solved = Solved(self._task, learner.pairs, None)
            return
        if retune:
            self._precision, self._tuned_at = solution.prior_precision or None, learner.pairs
        self._solved = Solved(self._task, learner.pairs, solution.map)

    def _sought_precision(self, prior: KBMap) -> float | Literal["evidence"]:
        return blockwise_precision(prior, self._q, self._x) if follow_a_path(prior, self._q) else "evidence"

    def poll(self) -> Solved | None:
        """The answer to the last `solve`, once."""
        solved, self._solved = self._solved, None
        return solved

    @property
    def _started(self) -> ExactLearner:
        if self._learner is None:
            raise RuntimeError("start a task first")
        return self._learner
