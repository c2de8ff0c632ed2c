"""Our KB-Map learners: the instant one and the exact one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from benchmarks.peers.problem import Competitor, Fitted, Problem, at_most
from kbmaps import NLMS, ExactLearner, KBMap, RigidChain, learning_bases, with_refitted_tool
from kbmaps.arrays import FloatArray

_REPLAYS = 4
_MOST_JOINTS_NLMS, _MOST_JOINTS_EXACT = 10, 8


@dataclass(frozen=True)
class LearntMap:
    """A map, and the chain whose orientations determine the effect of a moved tool."""

    kbmap: KBMap
    chain: RigidChain | None

    def predict(self, q: FloatArray) -> FloatArray:
        return self.kbmap.predict(q)


def start_map(problem: Problem) -> KBMap:
    """Return the nominal map, or one that predicts the mean of the pairs, in bases over the working range."""
    prismatic = None if problem.drawing is None else list(problem.drawing.prismatic)
    bases = learning_bases(problem.low, problem.high, prismatic)
    if problem.drawing is not None:
        return problem.drawing.to_kbmap(bases)
    net = np.zeros((3, *(basis.size for basis in bases)))
    net[(slice(None), *(0,) * len(bases))] = problem.x.mean(axis=0)
    return KBMap(bases, net)


def _start(problem: Problem, earlier: Fitted | None) -> KBMap:
    """Return the start map; after a tool change, the earlier map with the marker refitted."""
    if not isinstance(earlier, LearntMap):
        return start_map(problem)
    if earlier.chain is None:
        return earlier.kbmap
    return with_refitted_tool(earlier.kbmap, earlier.chain, problem.q, problem.x, problem.sigma)


def learn_nlms(problem: Problem, earlier: Fitted | None) -> Fitted:
    learner = NLMS(_start(problem, earlier))
    learner.replay(problem.q, problem.x)
    for _ in range(_REPLAYS):
        learner.replay(problem.q, problem.x, problem.rng.permutation(problem.pairs))
    return LearntMap(learner.map, problem.drawing)


def learn_exact(precision: Literal["evidence"] | None, problem: Problem, earlier: Fitted | None) -> Fitted:
    learner = ExactLearner(_start(problem, earlier))
    learner.learn(problem.q, problem.x)
    return LearntMap(learner.solve(precision).map, problem.drawing)


_TOO_MANY = at_most(_MOST_JOINTS_EXACT, "3^d control points and their factor do not fit beyond 8 joints")
COMPETITORS = (
    Competitor(
        "nlms",
        "KB-Map, NLMS",
        "ours",
        learn_nlms,
        "The instant learner, step 0.5, one pass and four replays; after a tool change the marker is refitted first.",
        at_most(_MOST_JOINTS_NLMS, "3^d control points: more than 10 joints are for the tensor train"),
    ),
    Competitor(
        "exact",
        "KB-Map, exact",
        "ours",
        partial(learn_exact, None),
        "Least squares without regularisation; with fewer pairs than control points the solution nearest to the start.",
        _TOO_MANY,
    ),
    Competitor(
        "evidence",
        "KB-Map, evidence",
        "ours",
        partial(learn_exact, "evidence"),
        "Least squares around the start (drawing, mean, or earlier map), regularised by the marginal likelihood.",
        _TOO_MANY,
    ),
)
