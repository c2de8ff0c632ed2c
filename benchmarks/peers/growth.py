"""Growth of time and memory with the joints and with the pairs, compared with theory."""

from __future__ import annotations

import math
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

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


Law = Callable[[float], float]


@dataclass(frozen=True)
class Series:
    """A learner measured at growing numbers of joints or pairs, and theoretical laws of its cost, up to a factor."""

    what: Literal["joints", "pairs"]
    competitor: str
    sizes: Sequence[int]
    time: Law
    memory: Law
    text: str


_JOINTS = (4, 6, 8, 10, 15, 20, 30)
_PAIRS = (100, 300, 1000, 3000)
_PAIRS_FULL_MAP, _PAIRS_A_JOINT = 64, 12
_JOINTS_BY_PAIRS = 6
SERIES = (
    Series("joints", "nlms", range(2, 11), lambda d: 3.0**d, lambda d: 3.0**d, "3ᵈ and 3ᵈ"),
    Series("joints", "train", _JOINTS, lambda d: d**3, lambda d: d**2, "n (24 d)² and 36 n d, so d³ and d²"),
    Series("joints", "rigid", _JOINTS, lambda d: d**3, lambda d: d**2, "n (5 d)² and 15 n d, so d³ and d²"),
    Series("pairs", "nlms", _PAIRS, lambda n: n, lambda _: 1.0, "n and constant"),
    Series("pairs", "train", _PAIRS, lambda n: n, lambda n: n, "n and n"),
    Series("pairs", "rigid", _PAIRS, lambda n: n, lambda n: n, "n and n"),
    Series("pairs", "gp", _PAIRS, lambda n: n**3, lambda n: n**2, "n³ and n²"),
)


def measure(known: Sequence[Growth], deadline: Callable[[], bool]) -> list[Growth]:
    """Return the known entries and measure the missing ones, one per size; stop early once `deadline()` is true."""
    entries = list(known)
    measured = {(entry.what, entry.competitor, entry.size) for entry in known}
    for series in SERIES:
        for size in series.sizes:
            if (series.what, series.competitor, size) in measured:
                continue
            if deadline():
                return entries
            entries.append(Growth(series.what, series.competitor, size, *_cost(series, size)))
    return entries


def _shape(series: Series, size: int) -> tuple[int, int]:
    """Return the numbers of joints and pairs."""
    if series.what == "pairs":
        return _JOINTS_BY_PAIRS, size
    return size, _PAIRS_FULL_MAP if series.competitor == "nlms" else _PAIRS_A_JOINT * size


def _cost(series: Series, size: int) -> tuple[float, float]:
    """Return the best CPU time to learn [s], and the peak memory [MiB]."""
    problem = _problem(*_shape(series, size))
    learn = BY_KEY[series.competitor].learn
    best = math.inf
    for _ in range(_REPEATS):
        begin = time.process_time()
        learn(problem, None)
        best = min(best, time.process_time() - begin)
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
