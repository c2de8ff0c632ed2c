"""What learning and predicting cost at seven joints: `python -m benchmarks.nlms_update`.

The normalised-LMS step, basis functions and checks of its input included, is compared with padasip's FilterNLMS, one
filter a coordinate, which is handed its 2187 features ready-made. Both run alternately in this one process, so their
ratio holds on a busy machine; the absolute times are those of the machine at that moment.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import resource
import time

import numpy as np
from padasip.filters import FilterNLMS

from benchmarks.humanoid_arm import JOINTS, guided_path, nominal_chain
from benchmarks.timing import interleaved_medians_us
from kbmaps import NLMS, ExactLearner, KBMap, SupportSet, learning_bases
from kbmaps.arrays import FloatArray

PADASIP_LIMIT = 3.0


def start_map() -> KBMap:
    turn = np.full(JOINTS, np.pi)
    return nominal_chain().to_kbmap(learning_bases(-turn, turn))


def online_step(kbmap: KBMap, q: FloatArray, x: FloatArray) -> None:
    learner, block = NLMS(kbmap), NLMS(kbmap)
    filters = [FilterNLMS(n=kbmap.size, mu=0.5) for _ in range(3)]
    features, angles, position = kbmap.weights(q[0]), q[0], x[0]
    targets = [float(value) for value in position]
    support = SupportSet(kbmap.bases)
    for row in q:
        support.add(row)

    def padasip_step() -> None:
        for one, target in zip(filters, targets, strict=True):
            one.adapt(target, features)

    costs = interleaved_medians_us(
        {
            "padasip FilterNLMS x 3, features for free": padasip_step,
            "NLMS.learn, weights included": lambda: learner.learn(angles, position),
            "KBMap.predict, one configuration": lambda: kbmap.predict(angles),
            "KBMap.jacobian, one configuration": lambda: kbmap.jacobian(angles),
            f"SupportSet.unexplained, {support.size} kept": lambda: support.unexplained(angles),
        }
    )
    batches = interleaved_medians_us(
        {
            "NLMS.replay, per pair of 600": lambda: block.replay(q, x),
            "KBMap.predict, per row of 600": lambda: kbmap.predict(q),
        },
        rounds=20,
        calls=5,
    )
    for name, cost in costs.items():
        print(f"  {name:45s} {cost:8.1f} us")
    for name, cost in batches.items():
        print(f"  {name:45s} {cost / len(q):8.1f} us")
    padasip_cost, step_cost = (costs[name] for name in list(costs)[:2])
    print(f"  ratio NLMS.learn / padasip: {step_cost / padasip_cost:.2f} (goal: at most {PADASIP_LIMIT:.0f})")


def exact_learner(kbmap: KBMap, rng: np.random.Generator) -> None:
    print(f"exact learner, {kbmap.size} control points")
    learner = ExactLearner(kbmap)
    # The step to 2200 holds the one change from kept rows to their QR factor, at 2187.
    for total in (600, 2000, 2200, 4000, 6000):
        n = total - learner.pairs
        q = guided_path(n, rng).q
        x = nominal_chain().with_tool([0.05, 0.0, 0.0]).positions(q) + 0.003 * rng.normal(size=(n, 3))
        begin = time.perf_counter()
        learner.learn(q, x)
        # A solve makes the learner take in what it still holds back, so that its cost lands where it belongs.
        learner.solve(1.0)
        middle = time.perf_counter()
        learner.solve(1.0)
        fixed = time.perf_counter()
        learner.solve("evidence")
        end = time.perf_counter()
        per_pair = max(middle - begin - (fixed - middle), 0.0) / n * 1e6
        print(
            f"  {total:5d} pairs: learn {per_pair:7.1f} us a pair; "
            f"solve {1e3 * (fixed - middle):4.0f} ms, with the evidence's ridge {1e3 * (end - fixed):4.0f} ms"
        )
    print(f"  peak memory of this process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


def main() -> None:
    rng = np.random.default_rng(0)
    kbmap = start_map()
    q = guided_path(600, rng).q
    x = nominal_chain().with_tool([0.05, 0.0, 0.0]).positions(q)
    print(f"one pair at {JOINTS} joints (medians of interleaved rounds; {os.cpu_count()} cores, shared machine)")
    online_step(kbmap, q, x)
    exact_learner(kbmap, rng)


if __name__ == "__main__":
    main()
