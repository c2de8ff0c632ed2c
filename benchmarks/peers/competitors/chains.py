"""Our learners of a rigid chain and of a tensor train."""

from __future__ import annotations

import copy
import math

from benchmarks.peers.problem import Competitor, Fitted, Problem, any_of, at_most, needs_drawing
from kbmaps import (
    ChainTolerances,
    RecursiveRigidLearner,
    RigidChain,
    RigidLearner,
    TensorLearner,
    TensorSettings,
    find_chain,
    learning_bases,
)

_FREE = ChainTolerances(axes=math.inf, points=math.inf, tool=math.inf)
_MOST_JOINTS_FOUND = 15
_PER_AXIS = math.sqrt(3.0)
_ALL = TensorSettings(refit_every=1_000_000)


def learn_rigid(problem: Problem, earlier: Fitted | None) -> Fitted:
    """Fit the batch learner; after a tool change start from the earlier posterior, widened by the tool's move."""
    if isinstance(earlier, RigidLearner):
        learner = _with_other_tool(earlier, problem)
    else:
        learner = RigidLearner(*drawing_of(problem))
    learner.learn(problem.q, problem.x, problem.sigma)
    learner.predict(problem.q[0])
    return learner


def learn_found(problem: Problem, earlier: Fitted | None) -> Fitted:
    if isinstance(earlier, RigidLearner):
        learner = _with_other_tool(earlier, problem)
    else:
        chain = find_chain(problem.q, problem.x, rng=problem.rng, sigma=problem.sigma)
        learner = RigidLearner(chain, _FREE)
    learner.learn(problem.q, problem.x, problem.sigma)
    learner.predict(problem.q[0])
    return learner


def learn_recursive(problem: Problem, earlier: Fitted | None) -> Fitted:
    if isinstance(earlier, RecursiveRigidLearner):
        learner = RecursiveRigidLearner.from_bytes(earlier.to_bytes())
        learner.tool_changed((problem.tool_move or 0.0) / _PER_AXIS)
    else:
        learner = RecursiveRigidLearner(*drawing_of(problem))
    learner.learn(problem.q, problem.x, problem.sigma)
    return learner


def learn_train(problem: Problem, earlier: Fitted | None) -> Fitted:
    if isinstance(earlier, TensorLearner):
        learner = copy.deepcopy(earlier)
        learner.tool_changed((problem.tool_move or 0.0) / _PER_AXIS)
    else:
        bases = learning_bases(problem.low, problem.high)
        if problem.drawing is None or problem.tolerances is None:
            learner = TensorLearner(bases, settings=_ALL)
        else:
            tolerances = problem.tolerances
            learner = TensorLearner.around(
                problem.drawing,
                bases,
                _ALL,
                turn_std=tolerances.axes,
                shift_std=tolerances.points,
                marker_std=min(tolerances.tool, 0.1),
            )
    learner.learn(problem.q, problem.x, problem.sigma)
    learner.refit()
    return learner


def drawing_of(problem: Problem) -> tuple[RigidChain, ChainTolerances]:
    """Return the nominal model and its tolerances.

    Raises:
        ValueError: the problem has none.
    """
    if problem.drawing is None or problem.tolerances is None:
        raise ValueError("this learner starts from a drawing")
    return problem.drawing, problem.tolerances


def _with_other_tool(earlier: RigidLearner, problem: Problem) -> RigidLearner:
    moved = earlier.belief.with_other_tool((problem.tool_move or 0.0) / _PER_AXIS)
    return RigidLearner(earlier.nominal, earlier.tolerances, moved)


def _all_turn(problem: Problem) -> str | None:
    return "draws turning joints only" if problem.drawing is not None and problem.drawing.prismatic.any() else None


def _enough_for_a_train(problem: Problem) -> str | None:
    needed = TensorLearner(learning_bases(problem.low, problem.high)).pairs_needed
    if problem.drawing is None and problem.pairs < needed:
        return f"from nothing a train of {problem.joints} joints takes {needed} pairs"
    return None


def _enough_for_a_chain(problem: Problem) -> str | None:
    needed = -(-(4 * problem.joints + 3) // 3)
    if problem.tool_move is None and problem.pairs < needed:
        return f"a chain of {problem.joints} joints has {4 * problem.joints + 3} unknowns: {needed} pairs"
    return None


COMPETITORS = (
    Competitor(
        "rigid",
        "Rigid chain, from the drawing",
        "ours",
        learn_rigid,
        "The most probable rigid chain around the drawing; after a tool change on from what it believed.",
        needs_drawing,
    ),
    Competitor(
        "rigid-nothing",
        "Rigid chain, from nothing",
        "ours",
        learn_found,
        "The best chain of up to 20 random starts, then the batch learner without a prior; never sees the drawing.",
        any_of(
            at_most(_MOST_JOINTS_FOUND, "random starts are not to be relied on beyond 15 joints"),
            _all_turn,
            _enough_for_a_chain,
        ),
    ),
    Competitor(
        "rigid-recursive",
        "Rigid chain, recursive",
        "ours",
        learn_recursive,
        "One Kalman-like update a pair around the drawing.",
        needs_drawing,
    ),
    Competitor(
        "train",
        "Tensor train",
        "ours",
        learn_train,
        "Alternating least squares and Gauss-Newton on a tensor train; around the drawing, or from nothing.",
        _enough_for_a_train,
    ),
)
