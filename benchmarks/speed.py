"""Cost of learning and predicting at seven joints, NumPy and compiled: `python -m benchmarks.speed`.

Input checks and basis functions are included, except for padasip's FilterNLMS (one filter a coordinate), which gets its
2187 features precomputed. numba is included if it is installed. All variants take turns in this one process, so their
ratios hold on a busy machine. Times are the thread's CPU times.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import importlib
import importlib.util
import statistics
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks.humanoid_arm import JOINTS, guided_path, nominal_chain
from benchmarks.timing import interleaved_medians_us
from kbmaps import NLMS, ChainTolerances, ExactLearner, KBMap, RecursiveRigidLearner, SupportSet, learning_bases
from kbmaps.arrays import FloatArray
from kbmaps.maps import code_path

ROUGH = ChainTolerances(axes=0.05, points=0.015, tool=0.03)
PAIRS = 600
NOISE_M = 0.003
# Goals [us]: NumPy, compiled.
GOALS: dict[str, tuple[float | None, float | None]] = {
    "NLMS.learn": (35.0, 3.0),
    "NLMS.replay, a pair": (8.0, None),
    "KBMap.predict": (12.0, 1.5),
    "KBMap.predict, a row of 600": (1.0, 1.0),
    "KBMap.jacobian": (None, None),
    "RecursiveRigidLearner.learn": (300.0, 8.0),
}
# A solve of each kind after each of these totals; 2187 control points lie between the second and the third.
STAGES = (600, 2000, 2200, 4000, 6000)
# A recursive rigid chain that learns pair by pair: its first pairs, and those between a full window and this total.
FIRST_PAIRS, FULL_WINDOW, STREAM = 100, 1000, 4000


def start_map() -> KBMap:
    turn = np.full(JOINTS, np.pi)
    return nominal_chain().to_kbmap(learning_bases(-turn, turn))


def kbmaps_calls(path: code_path.KernelPath, q: FloatArray, x: FloatArray) -> dict[str, Callable[[], object]]:
    """Return the calls of `GOALS` on this path; each takes one pair unless its name says otherwise."""
    with code_path.using(path):
        kbmap = start_map()
        learner, replayed = NLMS(kbmap), NLMS(kbmap)
        rigid = RecursiveRigidLearner(nominal_chain(), ROUGH)
    rigid.learn(q, x)
    one_q, one_x = q[0].copy(), x[0].copy()
    calls: list[Callable[[], object]] = [
        lambda: learner.learn(one_q, one_x),
        lambda: replayed.replay(q, x),
        lambda: kbmap.predict(one_q),
        lambda: kbmap.predict(q),
        lambda: kbmap.jacobian(one_q),
        lambda: rigid.learn(one_q, one_x),
    ]
    return dict(zip(GOALS, calls, strict=True))


def padasip_step(kbmap: KBMap, q: FloatArray, x: FloatArray) -> Callable[[], object]:
    from padasip.filters import FilterNLMS  # it imports scipy.stats, which takes a second

    filters = [FilterNLMS(n=kbmap.size, mu=0.5) for _ in range(3)]
    features, targets = kbmap.weights(q[0]), [float(value) for value in x[0]]

    def step() -> None:
        for one, target in zip(filters, targets, strict=True):
            one.adapt(target, features)

    return step


def numba_step(kbmap: KBMap, q: FloatArray, x: FloatArray) -> Callable[[], object]:
    """Return the same step in numba, without input checks; print the time to import and compile it."""
    begin = time.perf_counter()
    njit = importlib.import_module("numba").njit
    phases = np.array([basis.terms.phases for basis in kbmap.bases])
    mixes = np.array([basis.terms.mix for basis in kbmap.bases])
    net = kbmap.net.reshape(3, -1).copy()

    @njit(fastmath=True)
    def step(net: FloatArray, phases: FloatArray, mixes: FloatArray, q: FloatArray, x: FloatArray, mu0: float) -> None:
        weights, size, square = np.ones(net.shape[1]), 1, 1.0
        for k in range(len(q)):
            u, v = np.sin(0.5 * (q[k] - phases[k, 0])), np.sin(0.5 * (q[k] - phases[k, 1]))
            w = u * u * mixes[k, 0] + u * v * mixes[k, 1] + v * v * mixes[k, 2]
            square *= w[0] ** 2 + w[1] ** 2 + w[2] ** 2
            for i in range(size - 1, -1, -1):
                for j in range(2, -1, -1):
                    weights[3 * i + j] = weights[i] * w[j]
            size *= 3
        for o in range(3):
            predicted = 0.0
            for i in range(size):
                predicted += net[o, i] * weights[i]
            error = mu0 / square * (x[o] - predicted)
            for i in range(size):
                net[o, i] += error * weights[i]

    one_q, one_x = q[0].copy(), x[0].copy()
    step(net, phases, mixes, one_q, one_x, 0.5)
    print(f"  numba: {time.perf_counter() - begin:.1f} s to import it and compile one function")
    return lambda: step(net, phases, mixes, one_q, one_x, 0.5)


def online_costs(q: FloatArray, x: FloatArray, rounds: int = 40) -> dict[str, float]:
    """Return times [us] by name; those of `GOALS` are prefixed by their path."""
    rivals: dict[str, Callable[[], object]] = {}
    for path in code_path.available():
        rivals |= {f"{path} {name}": call for name, call in kbmaps_calls(path, q, x).items()}
    kbmap = start_map()
    rivals["padasip FilterNLMS x 3, features for free"] = padasip_step(kbmap, q, x)
    if importlib.util.find_spec("numba") is not None:
        rivals["numba NLMS step, input trusted"] = numba_step(kbmap, q, x)
    support = SupportSet(kbmap.bases)
    for row in q:
        support.add(row)
    rivals[f"SupportSet.unexplained, {support.size} kept"] = lambda: support.unexplained(q[0])
    of_many = {name for name in rivals if name.endswith(("a pair", "a row of 600"))}
    costs = interleaved_medians_us(
        {name: call for name, call in rivals.items() if name not in of_many},
        rounds=rounds,
        calls=100,
        clock=time.thread_time,
    )
    batches = interleaved_medians_us(
        {name: rivals[name] for name in of_many}, rounds=rounds // 2, calls=3, clock=time.thread_time
    )
    return costs | {name: cost / len(q) for name, cost in batches.items()}


def online(q: FloatArray, x: FloatArray) -> None:
    costs = online_costs(q, x)
    print(f"  {'[us]':30s} {'NumPy':>8s} {'goal':>6s} {'compiled':>9s} {'goal':>6s} {'NumPy / compiled':>17s}")
    for name, goals in GOALS.items():
        plain, compiled = (costs.get(f"{path} {name}") for path in ("numpy", "compiled"))
        ratio = plain / compiled if plain and compiled else None
        print(
            f"  {name:30s}{cell(plain, 9)}{cell(goals[0], 7)}{cell(compiled, 10)}{cell(goals[1], 7)}{cell(ratio, 18)}"
        )
    for name in (name for name in costs if not name.startswith(("numpy", "compiled"))):
        print(f"  {name:44s} {costs[name]:8.2f}")


def cell(value: float | None, width: int) -> str:
    return f"{'-':>{width}s}" if value is None else f"{value:{width}.2f}"


@dataclass(frozen=True)
class ExactCost:
    """Cost of the exact learner at a number of pairs: learning [us a pair] and solves [ms].

    Attributes:
        ridge: solve with a given ridge.
        plain: solve without a ridge.
        evidence: solve with the ridge chosen by the evidence.
    """

    pairs: int
    learn: float
    ridge: float
    plain: float
    evidence: float


def exact_costs(kbmap: KBMap, rng: np.random.Generator) -> tuple[list[ExactCost], float]:
    """Return the costs at each of `STAGES`, and the peak memory [MB] of learning and solving the last stage."""
    learner, costs = ExactLearner(kbmap), list[ExactCost]()
    q, x = np.empty((0, JOINTS)), np.empty((0, 3))
    for total in STAGES:
        n = total - learner.pairs
        new_q = guided_path(n, rng).q
        new_x = nominal_chain().with_tool([0.05, 0.0, 0.0]).positions(new_q) + NOISE_M * rng.normal(size=(n, 3))
        q, x = np.concatenate([q, new_q]), np.concatenate([x, new_x])
        begin = time.thread_time()
        learner.learn(new_q, new_x)
        per_pair = (time.thread_time() - begin) / n * 1e6
        costs.append(ExactCost(total, per_pair, *(solve_ms(learner, how) for how in (1.0, None, "evidence"))))
    tracemalloc.start()
    again = ExactLearner(kbmap)
    again.learn(q, x)
    again.solve(1.0)
    megabytes = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    return costs, megabytes


def exact_learner(kbmap: KBMap, rng: np.random.Generator) -> None:
    print(f"exact learner, {kbmap.size} control points (goals: 32 us a pair, solve 100 ms, 120 MB)")
    costs, megabytes = exact_costs(kbmap, rng)
    for cost in costs:
        print(
            f"  {cost.pairs:5d} pairs: learn {cost.learn:6.1f} us a pair; "
            f"solve with a given ridge {cost.ridge:4.0f} ms, "
            f"without {cost.plain:4.0f} ms, with the evidence's {cost.evidence:4.0f} ms"
        )
    print(f"  peak memory of learning and solving {STAGES[-1]} pairs: {megabytes:.0f} MB")


def solve_ms(learner: ExactLearner, precision: float | Literal["evidence"] | None) -> float:
    """Return the median time of three solves [ms]."""
    times: list[float] = []
    for _ in range(3):
        begin = time.thread_time()
        learner.solve(precision)
        times.append(1e3 * (time.thread_time() - begin))
    return statistics.median(times)


def stream_costs(path: code_path.KernelPath, rng: np.random.Generator) -> tuple[float, float]:
    """Return the cost of `RecursiveRigidLearner` per pair, refits included [us]: first pairs, then a full window."""
    q, x = some_pairs(rng, STREAM)
    with code_path.using(path):
        learner = RecursiveRigidLearner(nominal_chain(), ROUGH, window=FULL_WINDOW)
    took: list[float] = []
    for one_q, one_x in zip(q, x, strict=True):
        begin = time.thread_time()
        learner.learn(one_q, one_x)
        took.append(1e6 * (time.thread_time() - begin))
    return statistics.mean(took[:FIRST_PAIRS]), statistics.mean(took[FULL_WINDOW:])


def recursive_stream(rng: np.random.Generator) -> None:
    print("recursive rigid chain, refits included [us a pair]")
    for path in code_path.available():
        first, full = stream_costs(path, rng)
        print(f"  {path:9s} first {FIRST_PAIRS}: {first:6.0f}; pairs {FULL_WINDOW} to {STREAM}: {full:6.0f}")


def some_pairs(rng: np.random.Generator, count: int = PAIRS) -> tuple[FloatArray, FloatArray]:
    """Return q (count, 7) [rad] and x (count, 3) [m] of a guided path."""
    q = guided_path(count, rng).q
    return q, nominal_chain().with_tool([0.05, 0.0, 0.0]).positions(q) + NOISE_M * rng.normal(size=(count, 3))


def main() -> None:
    rng = np.random.default_rng(0)
    q, x = some_pairs(rng)
    load = os.getloadavg()[0]
    print(f"{JOINTS} joints (medians of interleaved rounds; {os.cpu_count()} cores, load average {load:.1f})")
    online(q, x)
    recursive_stream(rng)
    exact_learner(start_map(), rng)


if __name__ == "__main__":
    main()
