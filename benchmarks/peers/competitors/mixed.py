"""Our learners that combine a chain with a map, and several models side by side."""

from __future__ import annotations

from benchmarks.peers.competitors.chains import drawing_of
from benchmarks.peers.problem import Competitor, Fitted, Problem, any_of, needs_drawing
from benchmarks.side_by_side import SideBySide
from kbmaps import ResidualLearner


def learn_residual(problem: Problem, _: Fitted | None) -> Fitted:
    learner = ResidualLearner(*drawing_of(problem))
    learner.learn(problem.q, problem.x, problem.sigma)
    learner.predict(problem.q[0])
    return learner


def learn_ladder(problem: Problem, _: Fitted | None) -> Fitted:
    ladder = SideBySide(*drawing_of(problem), problem.low, problem.high)
    ladder.learn(problem.q, problem.x, problem.sigma)
    return ladder


def _one_tool(problem: Problem) -> str | None:
    return None if problem.tool_move is None else "learns one tool"


COMPETITORS = (
    Competitor(
        "ladder",
        "Models side by side",
        "ours",
        learn_ladder,
        "Chain with residual, chain and train side by side; the best on pairs before they were learnt answers.",
        any_of(needs_drawing, _one_tool),
    ),
    Competitor(
        "residual",
        "Rigid chain with residual",
        "ours",
        learn_residual,
        "The chain, and what the pairs say it errs by: encoders, gears, loads, camera, smooth rest.",
        any_of(needs_drawing, _one_tool),
    ),
)
