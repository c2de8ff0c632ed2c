"""False alarms of the whole learner: `python -m benchmarks.bending_arms [--truth NAME ...] [--seeds N] [--pairs N]`.

Nothing changes, but the arms are not rigid: those of `benchmarks.rough_truths`, with six joints, guided in steps of
1 to 3 degrees, with 2 mm of noise (--sigma). All models learn and are solved every 75 pairs (--every). Each line
lists the false alarms, how often each model answered, and the CPU time.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.changes import TOLERANCES, pair_of, walk
from benchmarks.rough_arm import rough_arm
from benchmarks.rough_truths import JOINTS, TRUTHS
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver


def stream(truth: str, seed: int, pairs: int, sigma: float, every: int) -> tuple[int, Counter[str]]:
    """Return the number of changes detected along one walk, and how often each model answered."""
    rng = np.random.default_rng([seed, 7])
    arm = rough_arm(JOINTS, rng, TOLERANCES)
    positions = TRUTHS[truth](arm, rng)
    q = walk(JOINTS, pairs, rng)
    x = positions(q) + sigma * rng.normal(size=(pairs, 3))
    limit = np.full(JOINTS, np.pi)
    settings = LearnerConfig(replays_per_pair=0.0, solve_every=every)
    learning = OnlineLearner(NominalModel(arm.drawing, -limit, limit, True, True), settings, DirectSolver())
    answered: Counter[str] = Counter()
    for k in range(pairs):
        learning.learn(pair_of(k, q[k], x[k], sigma**2 * np.eye(3)), k / 30.0)
        while (k + 1) % every == 0 and learning.work():
            pass
        answered[learning.snapshot.answering] += 1
    return learning.counters.changes, answered


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truth", nargs="+", choices=tuple(TRUTHS), default=["sag1", "sag3", "eccentric", "lens"])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--pairs", type=int, default=3000)
    parser.add_argument("--sigma", type=float, default=2.0, help="[mm]")
    parser.add_argument("--every", type=int, default=75, help="pairs between two solutions")
    arguments = parser.parse_args()
    for truth in arguments.truth:
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            began = time.process_time()
            alarms, answered = stream(truth, seed, arguments.pairs, 1e-3 * arguments.sigma, arguments.every)
            print(
                f"{truth:9s} seed {seed}: {alarms} false alarms in {arguments.pairs} pairs; "
                f"answered {dict(answered)}; {time.process_time() - began:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
