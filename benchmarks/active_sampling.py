"""Pairs saved by choosing the next pose: `python -m benchmarks.active_sampling [--seeds N] [--pairs N] [--only PART]`.

Arm, nominal model and noise are those of benchmarks.rigid_learner: the nominal model is wrong by 3 degrees an axis,
15 mm a point and 30 mm at the marker; the learner is given the noise of 10 mm. All runs start from the nominal model.
"chosen" takes the best of 200 random candidates within the given range; it refits after every pair, later after a tenth
of the pairs so far. "planned" plans ten pairs together, later half as many as there are, anywhere within the range.

The error is the distance to the truth at held-out poses within +-80 degrees, mean over poses and seeds. The ratio
compares the numbers of pairs (all counted) that lead to the same error: chosen over random. At most `random_times` as
many random pairs were tried, so a ratio of 1 / `random_times` means "at most". The 95 % interval is a bootstrap over
the seeds.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.bent_arm import RIGID, bent
from benchmarks.rough_arm import ROUGH, RoughArm, rough_arm
from benchmarks.timing import interleaved_medians_us
from kbmaps import ChainPosterior, RigidLearner, candidate_motions, expected_gain, next_pose, next_poses
from kbmaps.arrays import FloatArray

SIGMA = 0.01
TEST_DEG = 80.0
TEST_ROWS, REGION_ROWS, CANDIDATES = 500, 200, 200
LEVELS = (10, 20, 40, 80, 160)
BOOTSTRAPS = 1000


@dataclass(frozen=True)
class Setup:
    """The range of poses from which pairs may be taken.

    Attributes:
        name: name in the table.
        joints: number of joints.
        range_deg: half the range of the poses to choose from.
        first: number of pairs taken at random within `first_deg` before any choice.
        bend: kind of non-rigid effect, as in `bent`.
        random_times: ratio of random pairs tried to chosen pairs.
    """

    name: str
    joints: int = 7
    range_deg: float = 80.0
    first: int = 0
    first_deg: float = 20.0
    bend: str = RIGID
    random_times: int = 2


SETUPS = {
    "wide": Setup("d = 7, poses within +-80 deg"),
    "six": Setup("d = 6, poses within +-80 deg", joints=6),
    "local": Setup("d = 7, poses within +-20 deg, tested within +-80", range_deg=20.0, random_times=6),
    "opened": Setup("d = 7, 30 pairs within +-20 deg, then poses within +-80", first=30),
    "sag": Setup("d = 7, joints sag by 1 deg, poses within +-80 deg", bend="sag"),
    "eccentric": Setup("d = 7, encoders eccentric by 1 deg, poses within +-80 deg", bend="eccentric"),
}
COST = "cost"
RANDOM, CHOSEN, PLANNED = "random", "chosen", "planned"


class Trial:
    """One arm, its learner and the curve of its errors."""

    def __init__(self, setup: Setup, seed: int, way: str) -> None:
        self._rng = np.random.default_rng(seed)
        self.arm: RoughArm = bent(rough_arm(setup.joints, self._rng), setup.bend, self._rng)
        self._test = self.arm.angles(TEST_ROWS, TEST_DEG, self._rng)
        self._truth = self.arm.positions(self._test)
        self._learner = RigidLearner(self.arm.drawing, ROUGH)
        self._range_deg, self._way = setup.range_deg, way
        # Separate streams for pairs and choices, so that both ways meet the same arm, test poses and first pairs.
        if setup.first:
            self.learn(self.arm.angles(setup.first, setup.first_deg, self._rng))

    @property
    def pairs(self) -> int:
        return self._learner.pairs

    def learn(self, q: FloatArray) -> None:
        self._learner.learn(q, self.arm.measured(q, SIGMA, self._rng), SIGMA)

    def error(self) -> float:
        return float(np.linalg.norm(self._learner.predict(self._test) - self._truth, axis=1).mean())

    def poses(self, count: int) -> FloatArray:
        if self._way == RANDOM:
            return self.arm.angles(count, self._range_deg, self._rng)
        region = self.arm.angles(REGION_ROWS, TEST_DEG, self._rng)
        candidates = self.arm.angles(CANDIDATES, self._range_deg, self._rng)
        limit = np.full(self.arm.drawing.joints, np.radians(self._range_deg))
        limits = (-limit, limit) if self._way == PLANNED else None
        posterior = ChainPosterior.of(self._learner, noise=SIGMA)
        return next_poses(posterior, region, candidates, count, limits=limits)


def curve(setup: Setup, seed: int, way: str, last: int) -> dict[int, float]:
    """Return the mean error [m] by number of pairs."""
    trial = Trial(setup, seed, way)
    errors = {trial.pairs: trial.error()}
    while trial.pairs < last:
        batch = {
            RANDOM: max(2, trial.pairs // 5),
            CHOSEN: max(1, trial.pairs // 10),
            PLANNED: max(10, trial.pairs // 2),
        }[way]
        trial.learn(trial.poses(min(batch, last - trial.pairs)))
        errors[trial.pairs] = trial.error()
    return errors


def pairs_to_reach(level: float, pairs: FloatArray, errors: FloatArray) -> float:
    """Return the number of pairs at which a curve of mean errors first falls to a level, interpolated log-log.

    If the curve never falls that far, return its last number of pairs as a lower bound.
    """
    falling = np.minimum.accumulate(errors)
    return float(np.exp(np.interp(-np.log(level), -np.log(falling), np.log(np.maximum(pairs, 0.5)))))


@dataclass(frozen=True)
class Curves:
    """Error curves of several seeds at the same numbers of pairs.

    Attributes:
        pairs: (k,).
        errors: (seeds, k) [m].
    """

    pairs: FloatArray
    errors: FloatArray

    @classmethod
    def of(cls, curves: Sequence[Mapping[int, float]]) -> Curves:
        return cls(np.array(list(curves[0]), dtype=np.float64), np.array([list(one.values()) for one in curves]))

    def at(self, pairs: float, rows: NDArray[np.intp] | None = None) -> float:
        """Return the mean error at a number of pairs, interpolated log-log on the grid."""
        means = np.log(self.errors[slice(None) if rows is None else rows].mean(axis=0))
        return float(np.exp(np.interp(np.log(pairs), np.log(np.maximum(self.pairs, 0.5)), means)))


def share_of_pairs(pairs: float, chosen: Curves, random: Curves) -> tuple[float, FloatArray]:
    """Return the ratio of chosen to random pairs at equal mean error, and the same ratios for resampled seeds."""
    seeds = len(random.errors)
    resamples = np.random.default_rng(0).integers(0, seeds, (BOOTSTRAPS, seeds))
    ratios = [
        pairs / pairs_to_reach(chosen.at(pairs, rows), random.pairs, random.errors[rows].mean(axis=0))
        for rows in (np.arange(seeds), *resamples)
    ]
    return ratios[0], np.array(ratios[1:])


def compare(name: str, ways: Sequence[str], curves: dict[str, Curves], first: int) -> None:
    print(
        f"\n{name}: pairs; error [mm] at random; error with as many chosen, their ratio to random pairs for it (95 %)"
    )
    for pairs in LEVELS:
        if (
            not max(first, *(one.pairs[0] for one in curves.values()))
            < pairs
            <= min(one.pairs[-1] for one in curves.values())
        ):
            continue
        text = f"  {pairs:4d} {1e3 * curves[RANDOM].at(pairs):7.2f}"
        for way in ways:
            ratio, ratios = share_of_pairs(pairs, curves[way], curves[RANDOM])
            low, high = np.quantile(ratios, (0.025, 0.975))
            text += f"   {way} {1e3 * curves[way].at(pairs):6.2f}  {ratio:.2f} ({low:.2f}-{high:.2f})"
        print(text, flush=True)


def cost() -> None:
    rng = np.random.default_rng(0)
    arm = rough_arm(7, rng)
    learner = RigidLearner(arm.drawing, ROUGH)
    q = arm.angles(40, 20.0, rng)
    learner.learn(q, arm.measured(q, SIGMA, rng), SIGMA)
    region, candidates = arm.angles(REGION_ROWS, 80, rng), arm.angles(CANDIDATES, 80, rng)
    limit = np.full(7, np.radians(80.0))
    limits = (-limit, limit)
    posterior = ChainPosterior.of(learner)
    motions = candidate_motions(q, *limits, rng)
    costs = interleaved_medians_us(
        {
            f"next_pose, {CANDIDATES} candidates": lambda: next_pose(posterior, region, candidates),
            "the same, improved within limits": lambda: next_pose(posterior, region, candidates, limits=limits),
            "next_poses, ten planned": lambda: next_poses(posterior, region, candidates, 10, limits=limits),
            f"expected_gain, {len(motions)} motions": lambda: expected_gain(posterior, region, motions, (300,), rng),
        },
        rounds=10,
        calls=2,
    )
    print(f"\nCost at d = 7, a region of {REGION_ROWS} poses [ms]")
    for name, cost_us in costs.items():
        print(f"  {name:36s}{1e-3 * cost_us:8.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="the goal is over 50")
    parser.add_argument("--pairs", type=int, default=80, help="most pairs of a curve")
    parser.add_argument("--only", choices=[*SETUPS, COST], action="append", default=[])
    parser.add_argument("--first-seed", type=int, default=0)
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    last: int = arguments.pairs
    parts: list[str] = arguments.only or [*SETUPS, COST]
    for part in parts:
        if part == COST:
            cost()
            continue
        setup = SETUPS[part]
        most = {RANDOM: setup.random_times * last, CHOSEN: last, PLANNED: last}
        curves = {way: Curves.of([curve(setup, seed, way, n) for seed in seeds]) for way, n in most.items()}
        compare(setup.name, (CHOSEN, PLANNED), curves, setup.first)


if __name__ == "__main__":
    main()
