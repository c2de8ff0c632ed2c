"""What the rigid chain learners reach: `python -m benchmarks.rigid_learner [--seeds N] [--recording FOLDER]`.

The arm is a humanoid's, its marker seen by a camera on the head; d joints, configurations uniform within +-80 degrees,
10 mm of noise on each coordinate, drawing wrong by 3 degrees an axis, 15 mm a point and 30 mm at the marker (each
component) unless said. Errors are mean distances to the noise-free truth, in mm, means over the seeds. `bound` is what
the posterior of the right model with the right prior leaves. The noise is not told to the learner.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.humanoid_arm import guided_path
from benchmarks.rough_arm import ROUGH, RoughArm, least_error, rough_arm
from benchmarks.timing import interleaved_medians_us
from interfaces.robot import RobotDescription
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


def exactness(seeds: int) -> None:
    print("\nNoise-free, d = 7: seeds with an error below 1e-6 mm, and the worst error [mm]")
    for pairs in (11, 12, 13, 15):
        errors: list[float] = []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(7, rng)
            q = arm.angles(pairs, 80, rng)
            errors.append(mean_error_mm(batch(arm, q, arm.positions(q)), arm, arm.angles(TEST_ROWS, 80, rng)))
        print(f"  from the drawing, {pairs} pairs: {np.mean(np.array(errors) < 1e-6):4.0%}   {max(errors):.1e}")
    for pairs, reach in ((40, 80.0), (50, 80.0), (60, 80.0), (60, 5.0)):
        errors, taken = [], []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(7, rng)
            q = arm.angles(pairs, reach, rng)
            x, test = arm.positions(q), arm.angles(TEST_ROWS, 80, rng)
            begin = time.perf_counter()
            learner = RigidLearner(find_chain(q, x, rng=rng), FREE)
            learner.learn(q, x)
            errors.append(mean_error_mm(learner, arm, test))
            taken.append(time.perf_counter() - begin)
        share = np.mean(np.array(errors) < 1e-4)
        print(
            f"  from nothing, {pairs} pairs within +-{reach:.0f} deg: {share:4.0%} below 1e-4 mm, "
            f"median {np.median(errors):.1e}, worst {max(errors):.1e}, {np.mean(taken):.2f} s"
        )


def noisy(seeds: int) -> None:
    print("\nsigma 10 mm, d = 6: pairs, error at +-80 (bound), at +-120 deg; recursive at +-80; fit [s]; 68 % and 95 %")
    for pairs in (30, 100, 300, 2200):
        rows: list[list[float]] = []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(6, rng)
            q = arm.angles(pairs, 80, rng)
            x, test = arm.measured(q, SIGMA, rng), arm.angles(TEST_ROWS, 80, rng)
            begin = time.perf_counter()
            learner = batch(arm, q, x)
            estimate = learner.estimate(test)
            taken = time.perf_counter() - begin
            recursive = RecursiveRigidLearner(arm.drawing, ROUGH)
            recursive.learn(q, x)
            off = np.abs(estimate.x - arm.positions(test)) / estimate.sigma
            rows.append(
                [
                    mean_error_mm(learner, arm, test),
                    1e3 * least_error(arm, q, SIGMA, test, rng),
                    mean_error_mm(learner, arm, arm.angles(TEST_ROWS, 120, rng)),
                    mean_error_mm(recursive, arm, test),
                    taken,
                    float((off < 1.0).mean()),
                    float((off < 1.96).mean()),
                ]
            )
        near, bound, wide, online, taken, one, two = np.mean(rows, axis=0)
        print(
            f"  {pairs:5d}  {near:6.2f} ({bound:5.2f})  {wide:6.2f}  {online:6.2f}  {taken:6.3f}  {one:.1%} {two:.1%}"
        )


def from_nothing(seeds: int) -> None:
    print("\nsigma 10 mm, d = 6, from nothing (noise told to the search): pairs, error at +-80 deg, seeds above 30 mm")
    for pairs in (30, 40, 300):
        errors: list[float] = []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(6, rng)
            q = arm.angles(pairs, 80, rng)
            x = arm.measured(q, SIGMA, rng)
            learner = RigidLearner(find_chain(q, x, rng=rng, sigma=SIGMA), FREE)
            learner.learn(q, x)
            errors.append(mean_error_mm(learner, arm, arm.angles(TEST_ROWS, 80, rng)))
        print(f"  {pairs:5d}  {np.mean(errors):6.2f}  {np.sum(np.array(errors) > 30.0)} of {seeds}")


def local_zone(seeds: int) -> None:
    rows: list[tuple[float, float, float, float]] = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        arm = rough_arm(6, rng)
        q = arm.angles(300, 20, rng, centre_deg=rng.uniform(-60, 60, 6))
        test = arm.angles(TEST_ROWS, 80, rng)
        estimate = batch(arm, q, arm.measured(q, SIGMA, rng)).estimate(test)
        off = np.abs(estimate.x - arm.positions(test)) / estimate.sigma
        error = 1e3 * float(np.linalg.norm(estimate.x - arm.positions(test), axis=1).mean())
        bound = 1e3 * least_error(arm, q, SIGMA, test, rng)
        rows.append((error, bound, float((off < 1.0).mean()), float((off < 1.96).mean())))
    error, bound, one, two = np.mean(rows, axis=0)
    print(f"\n300 pairs within +-20 deg of a random centre, error over +-80 deg: {error:.1f} (bound {bound:.1f}) mm,")
    print(f"  within the 68 and 95 % intervals: {one:.1%} {two:.1%}")


def outliers(seeds: int) -> None:
    print("\n15 % of the pairs off by 200 mm, d = 6: pairs, error, error of the same learner on the good pairs, ratio")
    for pairs in (50, 200, 1000):
        rows: list[tuple[float, float]] = []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(6, rng)
            q = arm.angles(pairs, 80, rng)
            x, test = arm.measured(q, SIGMA, rng), arm.angles(TEST_ROWS, 80, rng)
            wrong = round(0.15 * pairs)
            direction = rng.normal(size=(wrong, 3))
            x[:wrong] += 0.2 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
            good = batch(arm, q[wrong:], x[wrong:])
            rows.append((mean_error_mm(batch(arm, q, x), arm, test), mean_error_mm(good, arm, test)))
        spoilt, clean = np.mean(rows, axis=0)
        print(f"  {pairs:5d}  {spoilt:6.2f}  {clean:6.2f}  {spoilt / clean:.3f}")


def new_tool(seeds: int) -> None:
    errors: list[float] = []
    for seed in range(seeds):
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
        errors.append(mean_error_mm(learner, after, after.angles(TEST_ROWS, 80, rng)))
    print(f"\nTool moved by 200 mm after 600 pairs, sigma 5 mm: {np.mean(errors):.2f} mm after 10 pairs (recursive)")


def guided_stream(seeds: int) -> None:
    """A marker moved by about 250 mm, met on a hand-guided path in steps of 1 to 3 degrees; sigma 20 mm, d = 7."""
    moved = 0.25 / math.sqrt(3.0)
    drawings = {
        "calibrated drawing": ChainTolerances(tool=moved),
        "rough drawing (2 deg, 10 mm)": ChainTolerances(axes=math.radians(2.0), points=0.01, tool=moved),
    }
    stages = (30, 300, 1700)
    for name, tolerances in drawings.items():
        rows: list[list[float]] = []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(7, rng, tolerances)
            q = guided_path(stages[-1], rng).q
            x = arm.measured(q, 0.02, rng)
            off_path = rng.normal(0.0, math.radians(22.0), (TEST_ROWS, 7))
            recursive = RecursiveRigidLearner(arm.drawing, tolerances)
            row: list[float] = []
            for stage in stages:
                recursive.learn(q[recursive.pairs : stage], x[recursive.pairs : stage], 0.02)
                whole = RigidLearner(arm.drawing, tolerances)
                whole.learn(q[:stage], x[:stage], 0.02)
                near = q[rng.integers(0, stage, TEST_ROWS)] + rng.normal(0.0, math.radians(5.0), (TEST_ROWS, 7))
                row += [mean_error_mm(model, arm, off_path) for model in (recursive, whole)]
                row += [1e3 * least_error(arm, q[:stage], 0.02, off_path, rng, tolerances)]
                row += [mean_error_mm(whole, arm, near)]
            rows.append(row)
        print(f"\nGuided path, {name}, sigma 20 mm: pairs, recursive, batch (bound) off the path; batch near it")
        for stage, figures in zip(stages, np.mean(rows, axis=0).reshape(len(stages), 4), strict=True):
            recursive_mm, batch_mm, bound, near_mm = figures
            print(f"  {stage:5d}  {recursive_mm:6.2f}  {batch_mm:6.2f} ({bound:5.2f})  {near_mm:6.2f}")


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


def recording(folder: Path, seeds: int) -> None:
    robot = RobotDescription.load(folder / "robot.toml")
    table = np.genfromtxt(folder / "measured.csv", delimiter=",", skip_header=1)
    q, x = table[:, : robot.chain.joints], table[:, -3:]
    tolerances = ChainTolerances(
        axes=np.radians(1.0),
        points=0.005,
        zeros=np.radians(1.0),
        tool=math.inf,
        base_rotation=math.inf,
        base_translation=math.inf,
    )
    print(f"\n{folder.name}: mean error of held-out rows [mm], {seeds} random splits; within 1 sigma with noise added")
    for pairs in (30, 100, 300, round(0.8 * len(q))):
        if pairs >= len(q):
            continue
        rows: list[tuple[float, float]] = []
        for seed in range(seeds):
            order = np.random.default_rng(seed).permutation(len(q))
            learner = RigidLearner(robot.chain, tolerances)
            learner.learn(q[order[:pairs]], x[order[:pairs]])
            estimate = learner.estimate(q[order[pairs:]])
            off = estimate.x - x[order[pairs:]]
            sigma = np.hypot(estimate.sigma, learner.report().noise)
            rows.append((1e3 * float(np.linalg.norm(off, axis=1).mean()), float((np.abs(off) < sigma).mean())))
        error, inside = np.mean(rows, axis=0)
        print(f"  {pairs:5d} pairs  {error:.4f}  {inside:.1%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--recording", type=Path, action="append", default=[], help="folder with a robot.toml")
    arguments = parser.parse_args()
    seeds: int = arguments.seeds
    for part in (exactness, noisy, from_nothing, local_zone, outliers, new_tool, guided_stream):
        part(seeds)
    cost()
    for folder in arguments.recording:
        recording(folder, min(seeds, 10))


if __name__ == "__main__":
    main()
