"""Accuracy of the rigid chain learners: `python -m benchmarks.rigid_learner [--seeds N]`.

The arm is a humanoid's, its marker seen by a camera on the head. It has d joints, configurations uniform within
+-80 degrees, and 10 mm of noise on each coordinate. Unless stated otherwise the nominal model is wrong by 3 degrees an
axis, 15 mm a point and 30 mm at the marker (each component). Errors are mean distances to the noise-free truth [mm],
means over the seeds. `bound` is the error of the posterior of the right model with the right prior. The learner is not
given the noise.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from dataclasses import astuple, dataclass

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.humanoid_arm import guided_path
from benchmarks.rough_arm import ROUGH, RoughArm, least_error, rough_arm
from benchmarks.timing import interleaved_medians_us
from kbmaps import NLMS, ChainTolerances, Model, RecursiveRigidLearner, RigidLearner, find_chain, learning_bases
from kbmaps.arrays import FloatArray

SIGMA = 0.01
FREE = ChainTolerances(axes=math.inf, points=math.inf, tool=math.inf)
TEST_ROWS = 500


def mean_error_mm(model: Model, arm: RoughArm, q: FloatArray) -> float:
    return 1e3 * float(np.linalg.norm(model.predict(q) - arm.positions(q), axis=1).mean())


def batch(arm: RoughArm, q: FloatArray, x: FloatArray) -> RigidLearner:
    learner = RigidLearner(arm.drawing, ROUGH)
    learner.learn(q, x)
    return learner


def exact_from_drawing(pairs: int, seed: int) -> float:
    """Return the error [mm] of a fit to noise-free pairs from the nominal model, d = 7."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(7, rng)
    q = arm.angles(pairs, 80, rng)
    return mean_error_mm(batch(arm, q, arm.positions(q)), arm, arm.angles(TEST_ROWS, 80, rng))


def exact_from_nothing(pairs: int, reach_deg: float, seed: int) -> tuple[float, float]:
    """Return error [mm] over +-80 degrees of a fit to noise-free pairs within the reach, d = 7, and CPU time [s]."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(7, rng)
    q = arm.angles(pairs, reach_deg, rng)
    x, test = arm.positions(q), arm.angles(TEST_ROWS, 80, rng)
    begin = time.process_time()
    learner = RigidLearner(find_chain(q, x, rng=rng), FREE)
    learner.learn(q, x)
    return mean_error_mm(learner, arm, test), time.process_time() - begin


def exactness(seeds: int) -> None:
    print("\nNoise-free, d = 7: seeds with an error below 1e-6 mm, and the worst error [mm]")
    for pairs in (11, 12, 13, 15):
        errors = [exact_from_drawing(pairs, seed) for seed in range(seeds)]
        print(f"  from the drawing, {pairs} pairs: {np.mean(np.array(errors) < 1e-6):4.0%}   {max(errors):.1e}")
    for pairs, reach in ((40, 80.0), (50, 80.0), (60, 80.0), (60, 5.0)):
        errors, taken = np.transpose([exact_from_nothing(pairs, reach, seed) for seed in range(seeds)])
        print(
            f"  from nothing, {pairs} pairs within +-{reach:.0f} deg: {np.mean(errors < 1e-4):4.0%} below 1e-4 mm, "
            f"median {np.median(errors):.1e}, worst {max(errors):.1e}, {np.mean(taken):.2f} s CPU"
        )


@dataclass(frozen=True)
class NoisyFit:
    """Errors of one fit [mm]: near within +-80, wide within +-120 degrees, online pair by pair; and its bounds.

    Attributes:
        seconds: CPU time.
        within_one, within_two: shares of coordinates within 1 and 1.96 sigma.
    """

    near: float
    near_bound: float
    wide: float
    wide_bound: float
    online: float
    seconds: float
    within_one: float
    within_two: float


def noisy_fit(pairs: int, seed: int) -> NoisyFit:
    """Fit noisy pairs from the rough nominal model, d = 6, sigma 10 mm."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(6, rng)
    q = arm.angles(pairs, 80, rng)
    x, test = arm.measured(q, SIGMA, rng), arm.angles(TEST_ROWS, 80, rng)
    begin = time.process_time()
    learner = batch(arm, q, x)
    estimate = learner.estimate(test)
    taken = time.process_time() - begin
    recursive = RecursiveRigidLearner(arm.drawing, ROUGH)
    recursive.learn(q, x)
    off = np.abs(estimate.x - arm.positions(test)) / estimate.sigma
    near_bound, wide_test = 1e3 * least_error(arm, q, SIGMA, test, rng), arm.angles(TEST_ROWS, 120, rng)
    return NoisyFit(
        near=mean_error_mm(learner, arm, test),
        near_bound=near_bound,
        wide=mean_error_mm(learner, arm, wide_test),
        wide_bound=1e3 * least_error(arm, q, SIGMA, wide_test, rng),
        online=mean_error_mm(recursive, arm, test),
        seconds=taken,
        within_one=float((off < 1.0).mean()),
        within_two=float((off < 1.96).mean()),
    )


def noisy(seeds: int) -> None:
    print(
        "\nsigma 10 mm, d = 6: pairs, error at +-80 (bound), at +-120 deg (bound); recursive at +-80; fit [s CPU]; "
        "68 % and 95 %"
    )
    for pairs in (30, 100, 300, 2200):
        rows = [astuple(noisy_fit(pairs, seed)) for seed in range(seeds)]
        near, bound, wide, wide_bound, online, taken, one, two = np.mean(rows, axis=0)
        print(
            f"  {pairs:5d}  {near:6.2f} ({bound:5.2f})  {wide:6.2f} ({wide_bound:5.2f})  {online:6.2f}  {taken:6.3f}  "
            f"{one:.1%} {two:.1%}"
        )


def found_error(pairs: int, seed: int) -> float:
    """Return the error [mm] without a nominal model, d = 6, with a noise sigma of 10 mm known to the search."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(6, rng)
    q = arm.angles(pairs, 80, rng)
    x = arm.measured(q, SIGMA, rng)
    learner = RigidLearner(find_chain(q, x, rng=rng, sigma=SIGMA), FREE)
    learner.learn(q, x)
    return mean_error_mm(learner, arm, arm.angles(TEST_ROWS, 80, rng))


def from_nothing(seeds: int) -> None:
    print("\nsigma 10 mm, d = 6, from nothing (noise told to the search): pairs, error at +-80 deg, seeds above 30 mm")
    for pairs in (30, 40, 300):
        errors = [found_error(pairs, seed) for seed in range(seeds)]
        print(f"  {pairs:5d}  {np.mean(errors):6.2f}  {np.sum(np.array(errors) > 30.0)} of {seeds}")


def local_fit(seed: int) -> tuple[float, float, float, float]:
    """Return error and bound [mm] over +-80 degrees of 300 pairs from a zone, and shares within 1 and 1.96 sigma."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(6, rng)
    q = arm.angles(300, 20, rng, centre_deg=rng.uniform(-60, 60, 6))
    test = arm.angles(TEST_ROWS, 80, rng)
    estimate = batch(arm, q, arm.measured(q, SIGMA, rng)).estimate(test)
    off = np.abs(estimate.x - arm.positions(test)) / estimate.sigma
    error = 1e3 * float(np.linalg.norm(estimate.x - arm.positions(test), axis=1).mean())
    bound = 1e3 * least_error(arm, q, SIGMA, test, rng)
    return error, bound, float((off < 1.0).mean()), float((off < 1.96).mean())


def local_zone(seeds: int) -> None:
    error, bound, one, two = np.mean([local_fit(seed) for seed in range(seeds)], axis=0)
    print(f"\n300 pairs within +-20 deg of a random centre, error over +-80 deg: {error:.1f} (bound {bound:.1f}) mm,")
    print(f"  within the 68 and 95 % intervals: {one:.1%} {two:.1%}")


def spoilt_fit(pairs: int, seed: int) -> tuple[float, float]:
    """Return errors [mm] with 15 % of the pairs off by 200 mm, and of the same learner on the good pairs alone."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(6, rng)
    q = arm.angles(pairs, 80, rng)
    x, test = arm.measured(q, SIGMA, rng), arm.angles(TEST_ROWS, 80, rng)
    wrong = round(0.15 * pairs)
    direction = rng.normal(size=(wrong, 3))
    x[:wrong] += 0.2 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    good = batch(arm, q[wrong:], x[wrong:])
    return mean_error_mm(batch(arm, q, x), arm, test), mean_error_mm(good, arm, test)


def outliers(seeds: int) -> None:
    print("\n15 % of the pairs off by 200 mm, d = 6: pairs, error, error of the same learner on the good pairs, ratio")
    for pairs in (50, 200, 1000):
        spoilt, clean = np.mean([spoilt_fit(pairs, seed) for seed in range(seeds)], axis=0)
        print(f"  {pairs:5d}  {spoilt:6.2f}  {clean:6.2f}  {spoilt / clean:.3f}")


def new_tool_error(seed: int) -> float:
    """Return the error [mm] 10 pairs after an announced tool change of 200 mm, d = 6, sigma 5 mm, pair by pair."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(6, rng)
    learner = RecursiveRigidLearner(arm.drawing, ROUGH)
    q = arm.angles(600, 80, rng)
    learner.learn(q, arm.measured(q, 0.005, rng))
    direction = rng.normal(size=3)
    moved = arm.change.copy()
    moved[arm.parameters.tool] += 0.2 * direction / np.linalg.norm(direction)
    after = RoughArm(arm.parameters, moved)
    learner.tool_changed(0.2)
    q = after.angles(10, 80, rng)
    learner.learn(q, after.measured(q, 0.005, rng))
    return mean_error_mm(learner, after, after.angles(TEST_ROWS, 80, rng))


def new_tool(seeds: int) -> None:
    error = np.mean([new_tool_error(seed) for seed in range(seeds)])
    print(f"\nTool moved by 200 mm after 600 pairs, sigma 5 mm: {error:.2f} mm after 10 pairs (recursive)")


MOVED_M = 0.25 / math.sqrt(3.0)
DRAWINGS = {
    "calibrated drawing": ChainTolerances(tool=MOVED_M),
    "rough drawing (2 deg, 10 mm)": ChainTolerances(axes=math.radians(2.0), points=0.01, tool=MOVED_M),
}
STAGES = (30, 300, 1700)


@dataclass(frozen=True)
class GuidedFit:
    """Errors [mm] off the path, pair by pair and of the batch, the bound of both; the batch's error near the path."""

    online: float
    off: float
    off_bound: float
    near: float
    near_bound: float


def guided_fits(drawing: str, seed: int) -> list[GuidedFit]:
    """Fit an arm with a marker moved by about 250 mm along a path in steps of 1 to 3 degrees, at each of `STAGES`."""
    tolerances, rng = DRAWINGS[drawing], np.random.default_rng(seed)
    arm = rough_arm(7, rng, tolerances)
    q = guided_path(STAGES[-1], rng).q
    x = arm.measured(q, 0.02, rng)
    off_path = rng.normal(0.0, math.radians(22.0), (TEST_ROWS, 7))
    recursive = RecursiveRigidLearner(arm.drawing, tolerances)
    fits: list[GuidedFit] = []
    for stage in STAGES:
        recursive.learn(q[recursive.pairs : stage], x[recursive.pairs : stage], 0.02)
        whole = RigidLearner(arm.drawing, tolerances)
        whole.learn(q[:stage], x[:stage], 0.02)
        near = q[rng.integers(0, stage, TEST_ROWS)] + rng.normal(0.0, math.radians(5.0), (TEST_ROWS, 7))
        fits.append(
            GuidedFit(
                mean_error_mm(recursive, arm, off_path),
                mean_error_mm(whole, arm, off_path),
                1e3 * least_error(arm, q[:stage], 0.02, off_path, rng, tolerances),
                mean_error_mm(whole, arm, near),
                1e3 * least_error(arm, q[:stage], 0.02, near, rng, tolerances),
            )
        )
    return fits


def guided_stream(seeds: int) -> None:
    for drawing in DRAWINGS:
        rows = [[astuple(fit) for fit in guided_fits(drawing, seed)] for seed in range(seeds)]
        print(f"\nGuided path, {drawing}, sigma 20 mm: pairs, recursive, batch (bound) off the path; batch near it")
        for stage, figures in zip(STAGES, np.mean(rows, axis=0), strict=True):
            online, off, off_bound, near, near_bound = figures
            print(f"  {stage:5d}  {online:6.2f}  {off:6.2f} ({off_bound:5.2f})  {near:6.2f} ({near_bound:5.2f})")


def cost() -> None:
    rng = np.random.default_rng(0)
    arm = rough_arm(7, rng)
    q = arm.angles(2000, 80, rng)
    x = arm.measured(q, SIGMA, rng)
    recursive = RecursiveRigidLearner(arm.drawing, ROUGH)
    recursive.learn(q[:300], x[:300])
    turn = np.full(7, np.pi)
    nlms = NLMS(arm.drawing.to_kbmap(learning_bases(-turn, turn)))
    costs = interleaved_medians_us(
        {
            "RecursiveRigidLearner.learn, one pair": lambda: recursive.learn(q[0], x[0]),
            "the same with all tolerances free": _everything_free(arm, q, x),
            "ChainParameters.linearised, one": lambda: arm.parameters.linearised(arm.change, q[:1]),
            "NLMS.learn, for comparison": lambda: nlms.learn(q[0], x[0]),
        }
    )
    print("\nCost at d = 7 [us] (and over that of NLMS.learn in the same run)")
    for name, cost_us in costs.items():
        print(f"  {name:40s}{cost_us:8.0f}  {cost_us / costs['NLMS.learn, for comparison']:6.1f}")


def _everything_free(arm: RoughArm, q: FloatArray, x: FloatArray):
    free = ChainTolerances(0.05, 0.015, 0.05, 0.01, 0.03, 0.1, 0.1)
    learner = RecursiveRigidLearner(arm.drawing, free)
    learner.learn(q[:300], x[:300])
    return lambda: learner.learn(q[0], x[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50)
    seeds: int = parser.parse_args().seeds
    for part in (exactness, noisy, from_nothing, local_zone, outliers, new_tool, guided_stream):
        part(seeds)
    cost()


if __name__ == "__main__":
    main()
