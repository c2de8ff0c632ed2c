"""Accuracy of the learners of the Kinematic Bézier Map family with few pairs.

Run `python -m benchmarks.few_pairs [--seeds N] [--only PART]`. The arm is a humanoid's, its marker seen by a camera on
the head; the nominal model is wrong by 3 degrees an axis, 15 mm a point and 30 mm at the marker (each component).
Errors are mean distances to the noise-free truth [mm], means over the seeds. Models with an uncertainty also have the
share of coordinates within one and 1.96 claimed sigmas [%]. No learner is given the noise.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.rough_arm import ROUGH, RoughArm, least_error, rough_arm
from kbmaps import (
    NLMS,
    ChainParameters,
    ChainTolerances,
    ExactLearner,
    JointBasis,
    KBMap,
    KernelLearner,
    Memory,
    Model,
    RigidChain,
    RigidLearner,
    StepSize,
    learning_bases,
)
from kbmaps.arrays import FloatArray
from kbmaps.kernel.kernel_learner import Predictor

SIGMA = 0.01
TEST_ROWS = 400
MOST_KERNEL_PAIRS = 1000


def bases(joints: int) -> tuple[JointBasis, ...]:
    reach = np.full(joints, np.radians(80.0))
    return learning_bases(-reach, reach)


def error_mm(model: Predictor, true: FloatArray, q: FloatArray) -> float:
    return 1e3 * float(np.linalg.norm(model.predict(q) - true, axis=1).mean())


def covered(model: Model, true: FloatArray, q: FloatArray) -> list[float]:
    estimate = model.estimate(q)
    off = np.abs(estimate.x - true) / estimate.sigma
    return [100.0 * float((off < limit).mean()) for limit in (1.0, 1.96)]


def taught(model: Model, q: FloatArray, x: FloatArray) -> Model:
    model.learn(q, x)
    return model


def nothing(joints: int) -> KBMap:
    return KBMap(bases(joints), np.zeros((3, *[3] * joints)))


def pseudo_inverse(joints: int, q: FloatArray, x: FloatArray) -> KBMap:
    learner = ExactLearner(nothing(joints))
    learner.learn(q, x)
    return learner.solve().map


def evidence(prior: RigidChain | None, joints: int, q: FloatArray, x: FloatArray) -> Model | KBMap:
    """Fit through the kernel if pairs are few, otherwise through the control points."""
    if len(q) <= MOST_KERNEL_PAIRS:
        return taught(KernelLearner(bases(joints), prior), q, x)
    learner = ExactLearner(nothing(joints) if prior is None else prior.to_kbmap(bases(joints)))
    learner.learn(q, x)
    return learner.solve("evidence").map


def one_table(arm: RoughArm, q: FloatArray, test: FloatArray, rng: np.random.Generator) -> list[float]:
    d, x, true = arm.drawing.joints, arm.measured(q, SIGMA, rng), arm.positions(test)
    return [
        error_mm(pseudo_inverse(d, q, x), true, test),
        error_mm(evidence(None, d, q, x), true, test),
        error_mm(evidence(arm.drawing, d, q, x), true, test),
        1e3 * least_error(arm, q, SIGMA, test, rng),
    ]


HEADER = "    n |  pinv | evidence, from nothing | from the drawing | bound"


def print_rows(label: str, rows: Sequence[Sequence[float]]) -> None:
    pinv, scratch, anchored, bound = np.mean(rows, axis=0)
    print(f"{label:>5} | {pinv:5.0f} | {scratch:22.1f} | {anchored:16.1f} | {bound:5.1f}")


def table(seeds: int) -> None:
    for joints, counts in ((6, (30, 50, 75, 100, 150, 300, 1000, 2000)), (7, (30, 100, 300))):
        print(f"\nd = {joints}, sigma 10 mm, pairs and test over +-80 deg\n{HEADER}")
        for n in counts:
            rows = []
            for seed in range(seeds):
                rng = np.random.default_rng(seed)
                arm = rough_arm(joints, rng)
                rows.append(one_table(arm, arm.angles(n, 80, rng), arm.angles(TEST_ROWS, 80, rng), rng))
            print_rows(str(n), rows)


def claims(seeds: int) -> None:
    print("\nd = 6, sigma 10 mm, kernel around the drawing: coordinates within 1 and 1.96 claimed sigma [%]")
    for n in (10, 30, 75, 300):
        shares: list[list[float]] = []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(6, rng)
            q, test = arm.angles(n, 80, rng), arm.angles(TEST_ROWS, 80, rng)
            learner = taught(KernelLearner(bases(6), arm.drawing), q, arm.measured(q, SIGMA, rng))
            shares.append(covered(learner, arm.positions(test), test))
        one, two = np.mean(shares, axis=0)
        print(f"  {n} pairs: {one:.0f} / {two:.0f}")


def local(seeds: int) -> None:
    print(f"\nd = 6, sigma 10 mm, pairs within +-20 deg of a random centre, test over +-80 deg\n{HEADER}")
    for n in (100, 300, 500):
        rows = []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(6, rng)
            q = arm.angles(n, 20, rng, centre_deg=rng.uniform(-60, 60, 6))
            rows.append(one_table(arm, q, arm.angles(TEST_ROWS, 80, rng), rng))
        print_rows(str(n), rows)


def exact(seeds: int) -> None:
    print("\nnoise-free, as many pairs as control points over +-80 deg: largest error [m] through the kernel and by QR")
    for joints in (3, 4, 5, 6):
        worst = np.zeros((seeds, 2))
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(joints, rng)
            q, test = arm.angles(3**joints, 80, rng), arm.angles(TEST_ROWS, 80, rng)
            x, true = arm.positions(q), arm.positions(test)
            for column, model in enumerate(
                (taught(KernelLearner(bases(joints), precision=None), q, x), pseudo_inverse(joints, q, x))
            ):
                worst[seed, column] = np.abs(model.predict(test) - true).max()
        print(f"  d = {joints}: median {np.median(worst, axis=0)}, worst {worst.max(axis=0)}")


def large(seeds: int) -> None:
    print("\nany number of joints: random chains of 120 mm links, sigma 10 mm, 500 pairs around the drawing")
    for joints in (10, 20, 30):
        rows: list[list[float]] = []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = random_arm(joints, rng)
            q, test = arm.angles(500, 80, rng), arm.angles(TEST_ROWS, 80, rng)
            x, true = arm.measured(q, SIGMA, rng), arm.positions(test)
            begin = time.perf_counter()
            learnt = error_mm(taught(KernelLearner(bases(joints), arm.drawing), q, x), true, test)
            rows.append([error_mm(arm.drawing, true, test), learnt, time.perf_counter() - begin])
        drawing, kernel, kernel_s = np.mean(rows, axis=0)
        print(f"  d = {joints}: drawing {drawing:.0f} mm, kernel {kernel:.0f} mm in {kernel_s:.2f} s")


def random_arm(joints: int, rng: np.random.Generator) -> RoughArm:
    fixed = np.tile(np.eye(4), (joints + 1, 1, 1))
    fixed[:, :3, :3] = Rotation.random(joints + 1, rng=rng).as_matrix()
    directions = rng.normal(size=(joints + 1, 3))
    fixed[:, :3, 3] = 0.12 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    axes = rng.normal(size=(joints, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    parameters = ChainParameters(RigidChain(fixed, axes, np.zeros(joints, dtype=np.bool_)))
    return RoughArm(parameters, parameters.standard_deviations(ROUGH) * rng.normal(size=parameters.size))


def tool(seeds: int) -> None:
    counts = (1, 3, 10, 30, 100, 300, 1700)
    print(f"\nd = 7, arm known, tool moved by 250 mm: error [mm] after {counts} pairs (law 1.6 sigma / root n)")
    for sigma, outliers in ((0.0, 0.0), (0.005, 0.0), (0.02, 0.0), (0.005, 0.15)):
        errors = np.zeros((seeds, len(counts)))
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(7, rng, ChainTolerances())
            direction = rng.normal(size=3)
            true = arm.drawing.with_tool(0.25 * direction / np.linalg.norm(direction))
            q, test = arm.angles(counts[-1], 80, rng), arm.angles(TEST_ROWS, 80, rng)
            x = true.positions(q) + sigma * rng.normal(size=q[:, :3].shape)
            x[rng.random(len(x)) < outliers] += 0.2 * direction[::-1] / np.linalg.norm(direction)
            learner, begin = RigidLearner(arm.drawing, ChainTolerances(tool=1.0)), 0
            for column, end in enumerate(counts):
                learner.learn(q[begin:end], x[begin:end])
                errors[seed, column] = error_mm(learner, true.positions(test), test)
                begin = end
        means = "  ".join(f"{mean:.2g}" for mean in errors.mean(axis=0))
        print(f"  sigma {1e3 * sigma:2.0f} mm, {outliers:3.0%} off by 200 mm: {means}")


def steps(seeds: int) -> None:
    counts = (100, 300, 1000, 3000, 10000)
    print(f"\nNLMS, d = 5, sigma 20 mm, from the drawing: error [mm] after {counts} pairs")
    schedules = (StepSize(1.0), StepSize(0.5), StepSize(0.1), StepSize(1.0, 100.0, 0.02), StepSize(1.0, 1000.0, 0.02))
    for schedule in schedules:
        errors = np.zeros((seeds, len(counts)))
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            arm = rough_arm(5, rng)
            q, test = arm.angles(counts[-1], 80, rng), arm.angles(TEST_ROWS, 80, rng)
            x, begin = arm.measured(q, 0.02, rng), 0
            learner = NLMS(arm.drawing.to_kbmap(bases(5)), schedule)
            for column, end in enumerate(counts):
                learner.replay(q[begin:end], x[begin:end])
                errors[seed, column] = error_mm(learner.map, arm.positions(test), test)
                begin = end
        means = "  ".join(f"{mean:5.1f}" for mean in errors.mean(axis=0))
        print(f"  mu0 {schedule.mu0}, decay {schedule.decay:6.0f}, floor {schedule.floor}: {means}")


def memory(seeds: int) -> None:
    runs = (1000, 10_000, 50_000)
    print(f"\nlong runs, d = 5, sigma 1 mm: largest difference [m] to a fresh learner after {runs} pairs")
    worst = np.zeros((2, len(runs)))
    for seed in range(min(seeds, 3)):
        rng = np.random.default_rng(seed)
        arm = rough_arm(5, rng)
        q = arm.angles(runs[-1], 80, rng)
        x, test = arm.measured(q, 0.001, rng), arm.angles(TEST_ROWS, 80, rng)
        prior = arm.drawing.to_kbmap(bases(5))
        window = KernelLearner(bases(5), arm.drawing, precision=0.01, memory=Memory(200))
        fading, begin = ExactLearner(prior, memory=Memory(forgetting=0.99)), 0
        for column, end in enumerate(runs):
            for part in np.array_split(np.arange(begin, end), 100):
                window.learn(q[part], x[part])
                fading.learn(q[part], x[part])
            fresh = KernelLearner(bases(5), arm.drawing, precision=0.01)
            fresh.learn(q[end - 200 : end], x[end - 200 : end])
            last = slice(max(end - 4000, 0), end)
            weighted = ExactLearner(prior)
            weighted.learn(q[last], x[last], 0.99 ** np.arange(len(q[last]) - 1, -1, -1.0))
            differences = (
                window.predict(test) - fresh.predict(test),
                fading.solve(0.01).map.predict(test) - weighted.solve(0.01).map.predict(test),
            )
            worst[:, column] = np.maximum(worst[:, column], [np.abs(one).max() for one in differences])
            begin = end
    print(f"  window of 200: {worst[0]}\n  forgetting 0.99: {worst[1]}")


PARTS: dict[str, Callable[[int], None]] = {
    "table": table,
    "claims": claims,
    "local": local,
    "exact": exact,
    "large": large,
    "tool": tool,
    "steps": steps,
    "memory": memory,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--only", choices=tuple(PARTS))
    chosen = parser.parse_args()
    for name, part in PARTS.items():
        if chosen.only in (None, name):
            part(chosen.seeds)


if __name__ == "__main__":
    main()
