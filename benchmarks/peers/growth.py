"""How time and memory grow with the joints and with the pairs, beside what theory says."""

from __future__ import annotations

import math
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.peers.problem import Fitted, Problem
from benchmarks.peers.registry import BY_KEY
from benchmarks.peers.results import Growth
from benchmarks.tensor_train import random_chain
from kbmaps import ChainParameters, ChainTolerances

_REACH = math.radians(80.0)
_SIGMA = 0.01
_TOLERANCES = ChainTolerances(axes=math.radians(3.0), points=0.015, tool=0.03)
_REPEATS = 2


@dataclass(frozen=True)
class Series:
    """A learner, the sizes it is measured at, and the law that theory gives, up to a factor."""

    competitor: str
    joints: Sequence[int]
    pairs_for: Callable[[int], int]
    law: Callable[[float], float]
    law_text: str


BY_JOINTS = (
    Series("nlms", (2, 3, 4, 5, 6, 7, 8, 9, 10), lambda _: 64, lambda d: 3.0**d, "3ᵈ"),
    Series("train", (4, 6, 8, 10, 15, 20, 30), lambda d: 12 * d, lambda d: d**3.0, "n·(24d)² at n = 12 d: d³"),
    Series("rigid", (4, 6, 8, 10, 15, 20, 30), lambda d: 12 * d, lambda d: d**3.0, "n·(5d)² at n = 12 d: d³"),
)
BY_PAIRS = {
    "nlms": (lambda n: n, "n"),
    "train": (lambda n: n, "n"),
    "rigid": (lambda n: n, "n"),
    "gp": (lambda n: n**3.0, "n³"),
}
PAIR_COUNTS = (100, 300, 1000, 3000)
_JOINTS_BY_PAIRS = 6


def measure(deadline: Callable[[], bool]) -> list[Growth]:
    """One entry a size; stops early when `deadline()` says so."""
    entries: list[Growth] = []
    for series in BY_JOINTS:
        for joints in series.joints:
            if deadline():
                return entries
            seconds, mebibytes = _cost(series.competitor, joints, series.pairs_for(joints))
            entries.append(Growth("joints", series.competitor, joints, seconds, mebibytes))
    for competitor in BY_PAIRS:
        for pairs in PAIR_COUNTS:
            if deadline():
                return entries
            entries.append(Growth("pairs", competitor, pairs, *_cost(competitor, _JOINTS_BY_PAIRS, pairs)))
    return entries


def _cost(competitor: str, joints: int, pairs: int) -> tuple[float, float]:
    """Time to learn [s], best of several, and the most memory that it holds at once [MiB]."""
    problem = _problem(joints, pairs)
    learn = BY_KEY[competitor].learn
    best = math.inf
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        learn(problem, None)
        best = min(best, time.perf_counter() - begin)
    tracemalloc.start()
    learnt: Fitted = learn(problem, None)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    del learnt
    return best, most / 2**20


def _problem(joints: int, pairs: int) -> Problem:
    rng = np.random.default_rng(joints)
    parameters = ChainParameters(random_chain(joints, rng))
    change = parameters.standard_deviations(_TOLERANCES) * rng.normal(size=parameters.size)
    reach = np.full(joints, _REACH)
    q = rng.uniform(-reach, reach, (pairs, joints))
    x = parameters.positions(change, q) + _SIGMA * rng.normal(size=(pairs, 3))
    return Problem(q, x, -reach, reach, rng, _SIGMA, parameters.reference, _TOLERANCES)
