"""Batch solver of all pairs at once: the rigid chain, the map around it, and the chain with residual."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.model_bank import EXACT, RESIDUAL, RIGID, LearntModel
from bodyschema.learning.solvers.orientation import BatchSettings, OrientationSolution, OrientationSolver
from bodyschema.learning.solvers.tolerance_selection import Tolerances, best_tolerances, select_tolerances
from kbmaps import (
    ChainBelief,
    ChainTolerances,
    ExactLearner,
    KBMap,
    Memory,
    NonFiniteError,
    ResidualLearner,
    ResidualModel,
    RigidLearner,
    SettingError,
    blockwise_precision,
    follow_a_path,
    shared_by,
)
from kbmaps.arrays import evenly_spread

log = logging.getLogger(__name__)


class SolverSettings:
    retune: float = 1.25  # growth of the number of pairs before the next search for the prior's precision
    max_fitted_pairs: int = 2000  # number of pairs that a chain is fitted to, evenly spread
    # With this growth of the number of pairs, this share of them is solved for first, if it is at least this many.
    first_growth: float = 1.5
    first_share: float = 0.75
    min_first_pairs: int = 5
    shared: float = 1.5  # minimum number of neighbours counting as one at which their correlation is not chance
    growth: float = 0.1  # while pairs are few, a solution is cheap, and renewed after this growth of their number
    # Memory and time grow with the square and the cube of the control points: 3^7 take 77 MB and 0.2 s
    largest_net: int = 2187


# The information about the chain of pairs older than those kept is folded into its prior, this many at a time.
FOLDED = SolverSettings.max_fitted_pairs


@dataclass(frozen=True)
class Task:
    number: int  # identifies it
    prior: KBMap  # the map to start from, in the bases of the learnt maps
    belief: ChainBelief  # prior of the chain before the first pair of this task
    residual: ResidualModel | None = None  # prior of the arm beyond that; None without any
    # True if the exact map keeps to `prior`, not to the rigid chain: it stands for pairs that are no longer kept
    prior_stays: bool = False
    # tolerances of `belief`, if the pairs may select narrower ones; None if they may not
    tolerances: ChainTolerances | None = None


@dataclass(frozen=True)
class Solved:
    """Solution for one model."""

    task: int  # number of the task it belongs to
    pairs: int  # number of pairs of the solution
    name: str = ""  # the model; empty if these pairs have no solution
    model: LearntModel | None = None  # None if these pairs have no solution
    belief: ChainBelief | ResidualModel | None = None  # new posterior of the arm; None if unchanged
    last: bool = True  # True if this is the last result of one `solve`
    # of a rigid chain, its posterior without the selection of narrower tolerances, the one to update with other pairs
    wide: ChainBelief | None = None
    orientation: OrientationSolution | None = None  # solution for the orientations; None: nothing new


class Solver(Protocol):
    """Solver of one task at a time, for the pairs since `start`."""

    def start(self, task: Task) -> None:
        """Forget all pairs and begin a new task."""

    def learn(
        self, q: FloatArray, x: FloatArray, cov: FloatArray | None = None, turns: FloatArray | None = None
    ) -> None:
        """Add pairs, q (n, d) [rad] and x (n, 3) [m], cov and turns as in `PairMemory.append`."""

    def solve(self) -> None:
        """Request the solutions of all pairs so far; `poll` returns them one by one, possibly later."""

    def poll(self) -> Solved | None:
        """Return the next answer to a `solve`, without waiting."""


class DirectSolver:
    """Solver that works in the caller's thread."""

    def __init__(self) -> None:
        self._task: Task | None = None
        self._solved_at = 0
        self._folded: ChainBelief | None = None
        self._folded_residual: ChainBelief | ResidualModel | None = None
        self._residual_at = 0
        self._exact: ExactLearner | None = None
        self._orientations: OrientationSolver | None = None
        self._precision: float | None = None
        self._tuned_at = self._pairs = 0
        self._solved: list[Solved] = []
        self._q = self._x = self._cov = np.empty((0, 0))

    def start(self, task: Task) -> None:
        """Forget all pairs and begin a new task."""
        self._solved_at = 0
        self._task, self._folded, self._folded_residual = task, task.belief, task.residual or task.belief
        within = Memory(window=BatchSettings.window)
        small = task.prior.size <= SolverSettings.largest_net
        self._exact = ExactLearner(task.prior, memory=within) if small else None
        self._orientations = OrientationSolver(task.prior.bases, with_map=small)
        self._precision, self._tuned_at, self._residual_at, self._pairs, self._solved = None, 0, 0, 0, []
        self._q, self._x, self._cov = np.empty((0, task.prior.joints)), np.empty((0, 3)), np.empty((0, 3, 3))

    def learn(
        self, q: FloatArray, x: FloatArray, cov: FloatArray | None = None, turns: FloatArray | None = None
    ) -> None:
        if self._orientations is not None and turns is not None:
            self._orientations.learn(q, x, turns)
        if self._exact is not None:
            self._exact.learn(q, x)
        self._pairs += len(q)
        self._q, self._x = np.vstack([self._q, q]), np.vstack([self._x, x])
        self._cov = np.concatenate([self._cov, np.full((len(q), 3, 3), np.nan) if cov is None else cov])
        while len(self._q) > BatchSettings.kept:
            oldest, before = self._first_pairs(FOLDED), self._residual_prior
            self._folded = fitted_belief(self._chain_prior, *oldest)
            self._folded_residual = fitted_residual(before, *oldest) or before
            self._q, self._x, self._cov = self._q[FOLDED:], self._x[FOLDED:], self._cov[FOLDED:]

    def solve(self) -> None:
        self._solved += self.solutions()

    def poll(self) -> Solved | None:
        return self._solved.pop(0) if self._solved else None

    def solutions(self) -> Iterator[Solved]:
        """Yield each model's solution as it is found, the rigid chain first: it is the quickest."""
        if self._task is None:
            raise RuntimeError("start a task first")
        task = self._task
        if self._pairs >= SolverSettings.first_growth * self._solved_at:
            yield from self._solve_first_pairs(task)
        self._solved_at = self._pairs
        wide = fitted_belief(self._chain_prior, self._q, self._x, self._cov)
        candidates = _tolerance_candidates(wide, task, self._q)
        residual_due = self._pairs >= BatchSettings.growth * self._residual_at
        turns = self._orientations if self._orientations is not None and self._orientations.due else None
        rigid = _chain_solution(task, self._pairs, wide, candidates)
        yield replace(rigid, last=self._exact is None and not residual_due and turns is None)
        if self._exact is not None:
            if not task.prior_stays and isinstance(rigid.model, KBMap):
                self._exact.rebase(rigid.model)
            yield self._solve_exact(task, self._exact, last=not residual_due and turns is None)
        if residual_due:
            self._residual_at = self._pairs
            before = self._residual_prior
            before = _with_tolerances(before, task, candidates) if isinstance(before, ChainBelief) else before
            residual = fitted_residual(before, self._q, self._x, self._cov)
            name = RESIDUAL if residual else ""
            yield Solved(task.number, self._pairs, name, residual, residual, last=turns is None)
        if turns is not None and isinstance(rigid.belief, ChainBelief):
            yield Solved(task.number, self._pairs, orientation=turns.solve(rigid.belief))

    def _solve_first_pairs(self, task: Task) -> Iterator[Solved]:
        """Yield the chain fitted to the first pairs only, so that the remaining pairs can test it."""
        count = int(len(self._q) * SolverSettings.first_share)
        if count >= SolverSettings.min_first_pairs:
            wide = fitted_belief(self._chain_prior, *self._first_pairs(count))
            pairs = self._pairs - len(self._q) + count
            yield replace(
                _chain_solution(task, pairs, wide, _tolerance_candidates(wide, task, self._q[:count])), last=False
            )

    def _solve_exact(self, task: Task, learner: ExactLearner, *, last: bool) -> Solved:
        """Solve least squares around the rigid chain.

        The evidence determines the prior's precision if pairs are independent. On a guided path, neighbours share their
        errors, which the evidence would take for shape; there, left-out blocks determine it.
        """
        retune = self._precision is None or learner.pairs >= SolverSettings.retune * self._tuned_at
        try:
            solution = learner.solve(self._choose_precision(learner.prior) if retune else self._precision)
        except SettingError:
            # The precision was lost in rounding: without a solution, the other models keep answering.
            self._precision = None
            return Solved(task.number, learner.pairs, last=last)
        if retune:
            self._precision, self._tuned_at = solution.prior_precision or None, learner.pairs
        return Solved(task.number, learner.pairs, EXACT, solution.map, last=last)

    def _choose_precision(self, prior: KBMap) -> float | Literal["evidence"]:
        return blockwise_precision(prior, self._q, self._x) if follow_a_path(prior, self._q) else "evidence"

    def _first_pairs(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self._q[:count], self._x[:count], self._cov[:count]

    @property
    def _chain_prior(self) -> ChainBelief:
        """Posterior of the chain before the kept pairs."""
        if self._folded is None:
            raise RuntimeError("start a task first")
        return self._folded

    @property
    def _residual_prior(self) -> ChainBelief | ResidualModel:
        """Posterior of the arm before the kept pairs."""
        if self._folded_residual is None:
            raise RuntimeError("start a task first")
        return self._folded_residual


def _tolerance_candidates(wide: ChainBelief, task: Task, q: FloatArray) -> list[Tolerances]:
    return [] if task.tolerances is None else select_tolerances(wide, task.tolerances, q)


def _chain_solution(task: Task, pairs: int, wide: ChainBelief, candidates: Sequence[Tolerances]) -> Solved:
    belief = _with_tolerances(wide, task, candidates)
    return Solved(task.number, pairs, RIGID, belief.chain.to_kbmap(task.prior.bases), belief, wide=wide)


def _with_tolerances(belief: ChainBelief, task: Task, candidates: Sequence[Tolerances]) -> ChainBelief:
    """Return the posterior of a chain averaged over these tolerances; unchanged if there are none."""
    return belief if task.tolerances is None or not candidates else best_tolerances(belief, task.tolerances, candidates)


def fitted_belief(prior: ChainBelief, q: FloatArray, x: FloatArray, cov: FloatArray | None = None) -> ChainBelief:
    """Return the posterior of a chain after pairs along a path.

    Neighbours share part of their errors; those that share them count as one.

    Args:
        prior: the posterior before these pairs.
        q: joint values (n, d) [rad].
        x: positions (n, 3) [m].
        cov: their covariances (n, 3, 3) [m²], NaN for a pair without one; None if no pair has any.
    """
    chosen = evenly_spread(len(q), SolverSettings.max_fitted_pairs)
    q, x = q[chosen], x[chosen]
    learner = RigidLearner(prior.parameters.reference, ChainTolerances(), prior)
    learner.learn(q, x)
    if cov is not None:
        learner.weigh(cov[chosen])
    inliers, data = learner.inliers, learner.data
    shared = shared_by(data.whitened(x - learner.predict(q))[inliers])
    if shared < SolverSettings.shared:
        return learner.belief
    reweighted = RigidLearner(prior.parameters.reference, ChainTolerances(), prior)
    noise = learner.scatter.noise * math.sqrt(shared)
    if data.shape is None:
        reweighted.learn(q[inliers], x[inliers], noise)
    else:
        reweighted.learn(q[inliers], x[inliers], cov=noise**2 * np.linalg.inv(data.shape.mT @ data.shape)[inliers])
    return replace(reweighted.belief, noise=learner.belief.noise)


def fitted_residual(
    prior: ChainBelief | ResidualModel, q: FloatArray, x: FloatArray, cov: FloatArray | None = None
) -> ResidualModel | None:
    """Return the posterior of a non-rigid arm after pairs along a path; arguments as in `fitted_belief`.

    None if it was lost in rounding: the other models keep answering.
    """
    chosen = evenly_spread(len(q), SolverSettings.max_fitted_pairs)
    parameters = prior.parameters if isinstance(prior, ChainBelief) else prior.features.parameters
    learner = ResidualLearner(parameters.reference, ChainTolerances(), prior)
    learner.learn(q[chosen], x[chosen])
    try:
        if cov is not None:
            learner.weigh(cov[chosen])
        return learner.model
    except (np.linalg.LinAlgError, NonFiniteError) as error:
        log.warning("the chain with residual has no solution for %d samples: %s", len(q), error)
        return None


class SolverClient:
    """Client that keeps one solver up to date. For the background thread alone.

    Nothing is sent while the solver works: a solver in a separate process does not read meanwhile, and the thread would
    block on the send.

    Attributes:
        fed: number of pairs of the current task that the solver has.
        busy: True if it has not answered the last request.
    """

    def __init__(self, solver: Solver, solve_every: int) -> None:
        self._solver, self._solve_every = solver, solve_every
        self.restart()

    @property
    def due(self) -> bool:
        """True if it is time to ask."""
        enough = min(self._solve_every, max(SolverSettings.growth * self._solved_at, 1.0))
        return self.fed > 0 and (self._solve_soon or self.fed - self._solved_at >= enough)

    def works_on(self, task: int) -> bool:
        """Return True if it has pairs of this task, and of no later one."""
        return self._task == task and self.fed > 0

    def has_solved(self, task: int, pairs: int) -> bool:
        """Return True if a solution for this many pairs of the task was requested and answered."""
        return self._task == task and not self.busy and self.fed == self._solved_at == pairs

    def restart(self) -> None:
        """Reset after the solver has lost everything."""
        self._task: int | None = None
        self.fed = self._solved_at = 0
        self.busy = self._solve_soon = False

    def solve_soon(self) -> None:
        """Request a solution although fewer pairs than usual are new."""
        self._solve_soon = self._solve_soon or self.fed > self._solved_at or self._task is None

    def begin(self, task: Task) -> bool:
        """Start a new task on the solver; return False if it already has this one."""
        if task.number == self._task:
            return False
        self._solver.start(task)
        self.fed = self._solved_at = 0
        self._task = task.number
        return True

    def feed(
        self, q: FloatArray, x: FloatArray, fed: int, cov: FloatArray | None = None, turns: FloatArray | None = None
    ) -> None:
        """Send pairs as in `Solver.learn`; with them the solver has `fed` pairs of the task."""
        self._solver.learn(q, x, cov, turns)
        self.fed = fed

    def request_solution(self) -> None:
        self._solver.solve()
        self.busy, self._solve_soon, self._solved_at = True, False, self.fed

    def poll(self) -> Solved | None:
        """Return the next answer if there is one, without waiting."""
        solved = self._solver.poll()
        if solved is not None:
            self.busy = not solved.last
        return solved
