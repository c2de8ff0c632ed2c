"""Bent arms on a hand-guided path: `python -m benchmarks.bent_walk [--seeds N] [--truth NAME ...] [--pairs N ...]`.

Six joints of a humanoid arm (two of the neck that carries the cameras, four of the arm) follow one smooth path in steps
of 1 to 3 degrees. The nominal model is wrong by 2 degrees an axis, 10 mm a point and 30 mm at the marker. The truths
are those of `benchmarks.rough_truths`. The noise is 3 mm on each coordinate, either independent for each pair or shared
between neighbours (AR(1), 0.9 from one pair to the next). Errors are mean distances to the noise-free truth [mm]:

    region  every joint moved by 5 degrees (standard deviation)
    later   the next pairs of the path, as many as were learnt

They are followed by the percentage of coordinates within 1 and 2 sigma.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.humanoid_arm import guided_path
from benchmarks.rough_arm import RoughArm, rough_arm
from benchmarks.rough_truths import JOINTS, ROUGH, TRUTHS
from bodyschema.learning.solvers.solver import fitted_belief
from kbmaps import (
    ChainBelief,
    ChainParameters,
    ChainTolerances,
    Estimate,
    ExactLearner,
    ResidualLearner,
    blockwise_precision,
    learning_bases,
)
from kbmaps.arrays import FloatArray

SIGMA_M = 0.003
SHARED = 0.9
REGION_DEG = 5.0
# Same values as in the daemon's settings.
TOLERANCES = ChainTolerances(
    axes=np.radians(3.0),
    points=0.015,
    zeros=np.radians(3.0),
    tool=0.03,
    base_rotation=np.radians(3.0),
    base_translation=0.03,
)
Predict = Callable[[FloatArray], Estimate]


def noise(pairs: int, rng: np.random.Generator, share: float) -> FloatArray:
    """Return noise (n, 3) [m] of SIGMA_M; `share` is the correlation of neighbours."""
    fresh = rng.normal(size=(pairs, 3))
    series = np.empty_like(fresh)
    series[0] = fresh[0]
    for k in range(1, pairs):
        series[k] = share * series[k - 1] + np.sqrt(1.0 - share**2) * fresh[k]
    return SIGMA_M * series


def rigid(arm: RoughArm, q: FloatArray, x: FloatArray) -> Predict:
    prior = ChainBelief.from_tolerances(ChainParameters(arm.drawing), TOLERANCES)
    belief = fitted_belief(prior, q, x)
    return lambda test: _of(*belief.predict_with_variance(test))


def exact(arm: RoughArm, q: FloatArray, x: FloatArray) -> Predict:
    prior = ChainBelief.from_tolerances(ChainParameters(arm.drawing), TOLERANCES)
    belief = fitted_belief(prior, q, x)
    reach = np.full(JOINTS, np.pi)
    chain = belief.chain.to_kbmap(learning_bases(-reach, reach))
    learner = ExactLearner(chain)
    learner.learn(q, x)
    solution = learner.solve(blockwise_precision(chain, q, x))
    return lambda test: _of(solution.map.predict(test), belief.predict_with_variance(test)[1])


def residual(arm: RoughArm, q: FloatArray, x: FloatArray) -> Predict:
    learner = ResidualLearner(arm.drawing, TOLERANCES)
    learner.learn(q, x)
    learner.predict(q[:1])
    return learner.estimate


def _of(x: FloatArray, variance: FloatArray) -> Estimate:
    return Estimate(x, np.sqrt(variance), np.ones(len(x), dtype=np.bool_))


LEARNERS = {"rigid": rigid, "exact": exact, "residual": residual}


def run(truth: str, learners: list[str], pairs: int, seed: int, share: float) -> list[list[float]]:
    """Return for each learner: error and coverage within 1 and 2 sigma in the region and later, and CPU time [s]."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(JOINTS, rng, ROUGH)
    positions = TRUTHS[truth](arm, rng)
    q, later = np.split(guided_path(2 * pairs, rng).q[:, :JOINTS], 2)
    x = positions(q) + noise(pairs, rng, share)
    tests = [q + np.radians(REGION_DEG) * rng.normal(size=q.shape), later]
    rows: list[list[float]] = []
    for name in learners:
        begin = time.process_time()
        estimate = LEARNERS[name](arm, q, x)
        taken, figures = time.process_time() - begin, []
        for test in tests:
            found = estimate(test)
            off = found.x - positions(test)
            ratios = np.abs(off) / found.sigma
            figures.append(1e3 * float(np.linalg.norm(off, axis=1).mean()))
            figures += [100.0 * float((ratios < k).mean()) for k in (1.0, 2.0)]
        rows.append([*figures, taken])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--truth", nargs="+", choices=tuple(TRUTHS), default=["rigid", "sag1", "sag3", "eccentric"])
    parser.add_argument("--pairs", nargs="+", type=int, default=[100, 300, 1000])
    parser.add_argument("--learner", nargs="+", choices=tuple(LEARNERS), default=list(LEARNERS))
    parser.add_argument("--share", type=float, nargs="+", default=[0.0, SHARED], help="correlation of the noise")
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    for truth in arguments.truth:
        for share in arguments.share:
            print(f"\n{truth}, share {share}: pairs, learner, region (1, 2 sigma), later (1, 2 sigma), worst, [s]")
            for pairs in arguments.pairs:
                rows = np.array([run(truth, arguments.learner, pairs, seed, share) for seed in seeds])
                for name, mean, worst in zip(arguments.learner, rows.mean(axis=0), rows.max(axis=0), strict=True):
                    near, near1, near2, later, later1, later2, taken = mean
                    print(
                        f"  {pairs:5d}  {name:9s} {near:6.2f} ({near1:3.0f} {near2:3.0f})"
                        f"  {later:6.2f} ({later1:3.0f} {later2:3.0f})  {worst[0]:6.2f}  {taken:6.2f}",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
