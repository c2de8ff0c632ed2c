"""Learn pair by pair, then again in random order, by the paper's rule, the daemon's learner and other models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.cli.terminal.screen import Say, counted
from bodyschema.interfaces.records import FloatArray, Pair, frozen_array
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver
from kbmaps import NLMS, JointBasis, KBMap, RigidChain

from .experiment import Curve, Tests, distances
from .models import WITH_DRAWING, Knowledge, learn_all, spread_counts

ALPHA = np.radians(60.0)
EVERY = 10
# The models are compared after this few pairs, and at the end of the online pairs.
EARLY = 30
RULE, LEARNER = "paper's rule", "this learner"
_LEAST_SIGMA_M = 1e-4


@dataclass(frozen=True)
class Stream:
    """Pairs in learning order: first as they arrived, then permuted.

    Attributes:
        name: description of the pairs.
        q, x: the pairs (n, d) [rad] and (n, 3) [m].
        sigma: 1-sigma of a coordinate that is given to the daemon's learner [m].
        order: indices of the pairs, one per cycle; the first n are 0 … n − 1.
        tests: test sets for the errors.
    """

    name: str
    q: FloatArray
    x: FloatArray
    sigma: float
    order: NDArray[np.intp]
    tests: Tests

    @property
    def online(self) -> int:
        """Return the number of online pairs, before the replay."""
        return len(self.q)


def in_stages(rng: np.random.Generator, online: int, cycles: int) -> NDArray[np.intp]:
    """Return the order of `cycles` cycles: online pairs first, then repeated permutations of all of them."""
    again = [rng.permutation(online) for _ in range(cycles // online + 1)]
    return np.concatenate([np.arange(online), *again])[:cycles]


def bernstein_map(chain: RigidChain, alpha: float = ALPHA) -> KBMap:
    """Return the chain in the paper's basis."""
    return chain.to_kbmap(tuple(JointBasis.bernstein(alpha) for _ in range(chain.joints)))


def papers_rule(prior: KBMap, stream: Stream, say: Say) -> dict[str, Curve]:
    """Run the paper's rule (eq. 20) with μ0 = 1 over all cycles; return a curve for each test."""
    learner = NLMS(prior, 1.0)
    curves = {test: Curve(RULE, "tab:red") for test in stream.tests}
    what = f"{RULE}, {stream.name}: cycles, {EVERY} at a time"
    for cycle in counted(say, what, range(0, len(stream.order), EVERY)):
        _test(learner.map.predict, stream.tests, curves, cycle)
        chosen = stream.order[cycle : cycle + EVERY]
        learner.replay(stream.q[chosen], stream.x[chosen])
    _test(learner.map.predict, stream.tests, curves, len(stream.order))
    return curves


def background(prior: KBMap, stream: Stream, say: Say) -> tuple[Curve, Curve]:
    """Return the error on each pair before the paper's rule learns it, and the distance between consecutive markers."""
    learner = NLMS(prior, 1.0)
    errors = Curve("each pair before it is learnt", "tab:green", thin=True)
    steps = Curve("distance of consecutive markers", "lightskyblue", thin=True)
    for cycle in counted(say, f"{RULE}, {stream.name}: each pair before it is learnt", range(len(stream.order))):
        chosen = stream.order[cycle]
        q, x = stream.q[chosen], stream.x[chosen]
        errors.add_one(cycle, float(np.linalg.norm(learner.map.predict(q) - x)))
        if cycle:
            steps.add_one(cycle, float(np.linalg.norm(x - stream.x[stream.order[cycle - 1]])))
        learner.learn(q, x)
    return errors, steps


def daemons_learner(nominal: RigidChain, stream: Stream, say: Say, *, tool_changed: bool) -> dict[str, Curve]:
    """Run the daemon's learner on the same pairs, each once and in order; it replays on its own."""
    limit = np.full(nominal.joints, np.pi)
    learning = OnlineLearner(NominalModel(nominal, -limit, limit), LearnerConfig(), DirectSolver())
    if tool_changed:
        learning.tool_changed()
    curves = {test: Curve(LEARNER, "tab:green") for test in stream.tests}
    cov = frozen_array(max(stream.sigma, _LEAST_SIGMA_M) ** 2 * np.eye(3))
    for number in counted(say, f"{LEARNER}, {stream.name}: pairs", range(stream.online)):
        if number % EVERY == 0:
            _test(lambda q: learning.snapshot.predict(q).x, stream.tests, curves, number)
        q, x = frozen_array(stream.q[number]), frozen_array(stream.x[number])
        learning.learn(Pair("reproduced", number + 1, 1, number / 30.0, "", q, x, cov), number / 30.0)
        while learning.work():
            pass
    _test(lambda q: learning.snapshot.predict(q).x, stream.tests, curves, stream.online)
    return curves


def learn_stream(
    stream: Stream, nominal: RigidChain, known: Knowledge, say: Say, *, tool_changed: bool
) -> dict[str, dict[str, Curve]]:
    """Run all models on one stream; return curves by model and test.

    Args:
        nominal: initial chain of the paper's rule and of the daemon's learner.
        known: prior knowledge of the other models.
        tool_changed: True if the tool change is reported to the daemon's learner.
    """
    found = {
        RULE: papers_rule(bernstein_map(nominal), stream, say),
        LEARNER: daemons_learner(nominal, stream, say, tool_changed=tool_changed),
    }
    counts = sorted({0, EARLY, *spread_counts(1, stream.online)})
    return found | learn_all(
        WITH_DRAWING, known, (stream.q, stream.x), counts, stream.tests, say=lambda said: say(f"{stream.name}, {said}")
    )


def _test(predict: Callable[[FloatArray], FloatArray], tests: Tests, curves: dict[str, Curve], count: int) -> None:
    for test, (q, x) in tests.items():
        curves[test].add(count, distances(predict(q), x))
