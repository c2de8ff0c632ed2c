"""Error of a random chain recovered from noise-free samples: `python -m benchmarks.exactness [--seeds N]`.

According to the paper 3^d samples determine the chain, wherever they lie. In float64, samples from a smaller cluster
lose digits outside it. Errors are the largest of 500 configurations within +-80 degrees [m], median (and worst) over
the seeds.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.tensor_train import random_chain
from kbmaps import ExactLearner, learning_bases, prediction_errors
from kbmaps.arrays import FloatArray

CASES = [("3^d samples, +-80 deg", 80.0, 1), ("2 x 3^d, +-20 deg", 20.0, 2), ("2 x 3^d, +-5 deg", 5.0, 2)]
REACH_DEG = 80.0
TEST_ROWS = 500


def errors(joints: int, cluster_deg: float, times: int, seed: int) -> FloatArray:
    """Return errors (500,) [m] within +-80 degrees after a multiple of 3^d pairs from a cluster."""
    rng = np.random.default_rng(seed)
    chain, prior = random_chain(joints, rng), random_chain(joints, rng)
    cluster, reach = (np.full(joints, np.radians(deg)) for deg in (cluster_deg, REACH_DEG))
    q = rng.uniform(-cluster, cluster, (times * 3**joints, joints))
    learner = ExactLearner(prior.to_kbmap(learning_bases(-reach, reach)), learning_bases(-cluster, cluster))
    learner.learn(q, chain.positions(q))
    test = rng.uniform(-reach, reach, (TEST_ROWS, joints))
    return prediction_errors(learner.solve().map, test, chain.positions(test))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    seeds = parser.parse_args().seeds
    print("joints" + "".join(f"{name:>30s}" for name, _, _ in CASES))
    for joints in range(1, 8):
        cells: list[str] = []
        for _, cluster_deg, times in CASES:
            largest = [errors(joints, cluster_deg, times, seed).max() for seed in range(seeds)]
            cells.append(f"{np.median(largest):9.1e} ({max(largest):8.1e})")
        print(f"{joints:6d}" + "".join(f"{cell:>30s}" for cell in cells))


if __name__ == "__main__":
    main()
