"""Accuracy of a tensor train by number of pairs: `python -m benchmarks.tensor_train [--seeds N] [--only PART]`.

Parts: exact, noisy, prior, cluster, bent, outliers, stream, cost. "Rough prior": every link is rotated by 3 degrees and
shifted by 15 mm, and the marker by 30 mm (standard deviations of each component); "mild": 2 degrees, 10 mm, 30 mm.
Unless stated otherwise, errors are distances to the noise-free truth at poses distributed like the pairs.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.humanoid_arm import built_chain, nominal_chain
from kbmaps import RigidChain, TensorLearner, TensorSettings, TensorTrain, learning_bases
from kbmaps.arrays import FloatArray

LINK_M = 0.15
TEST_POSES = 500
EXACT_M = 1e-6
Bend = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Outcome:
    """One fit: mean and largest error [m], CPU time [s], share of coordinates within 1 and 2 sigma."""

    mean: float
    largest: float
    seconds: float
    within_one: float
    within_two: float


@dataclass(frozen=True)
class Task:
    """Input of one fit.

    Attributes:
        joints: 6 and 7 are the humanoid arm, built with an error; others random chains.
        n: number of pairs.
        sigma: noise of a coordinate [m].
        reach_deg: half the range of the pairs.
        test_deg: half the range of the test poses.
        prior: (degrees, mm, mm) of the rough prior; None to learn without a prior.
        bend: "rigid", "eccentric" (encoders off by 1 deg · sin) or "gain" (gears off by 1 %).
        outliers: share of pairs off by 200 mm.
    """

    joints: int
    n: int
    sigma: float = 0.0
    reach_deg: float = 80.0
    test_deg: float = 80.0
    prior: tuple[float, float, float] | None = None
    bend: str = "rigid"
    outliers: float = 0.0


def random_chain(joints: int, rng: np.random.Generator) -> RigidChain:
    fixed = np.tile(np.eye(4), (joints + 1, 1, 1))
    fixed[:, :3, :3] = Rotation.random(joints + 1, rng=rng).as_matrix()
    fixed[:, :3, 3] = LINK_M * rng.normal(size=(joints + 1, 3))
    axes = rng.normal(size=(joints, 3))
    return RigidChain(fixed, axes / np.linalg.norm(axes, axis=1, keepdims=True), np.zeros(joints, dtype=np.bool_))


def true_chain(joints: int, rng: np.random.Generator) -> RigidChain:
    if joints not in (6, 7):
        return random_chain(joints, rng)
    chain = nominal_chain()
    if joints == 6:
        last = chain.fixed[6] @ chain.fixed[7]
        chain = RigidChain(np.concatenate([chain.fixed[:6], last[None]]), chain.axes[:6], chain.prismatic[:6])
    return built_chain(chain, rng)


def bend_of(kind: str, joints: int, rng: np.random.Generator) -> Bend:
    """Return a function from measured values q (n, d) [rad] to true joint angles."""
    if kind == "eccentric":
        phase = rng.uniform(-np.pi, np.pi, joints)
        return lambda q: q + np.radians(1.0) * np.sin(q + phase)
    if kind == "gain":
        gain = 1.0 + 0.01 * rng.choice([-1.0, 1.0], joints)
        return lambda q: q * gain
    return lambda q: q


def learner_for(task: Task, chain: RigidChain, rng: np.random.Generator, settings: TensorSettings) -> TensorLearner:
    reach = np.full(task.joints, np.radians(task.reach_deg))
    bases = learning_bases(-reach, reach)
    if task.prior is None:
        return TensorLearner(bases, settings=settings)
    axis_deg, shift_mm, tool_mm = task.prior
    nominal = built_chain(chain, rng, axis_deg=axis_deg, shift_mm=shift_mm, tool_mm=tool_mm)
    return TensorLearner.around(
        nominal, bases, settings, turn_std=np.radians(axis_deg), shift_std=1e-3 * shift_mm, marker_std=1e-3 * tool_mm
    )


def run(task: Task, seed: int) -> Outcome:
    rng = np.random.default_rng(seed)
    chain = true_chain(task.joints, rng)
    bend = bend_of(task.bend, task.joints, rng)
    learner = learner_for(task, chain, rng, TensorSettings(refit_every=task.n))
    reach, test_reach = np.radians(task.reach_deg), np.radians(task.test_deg)
    q = rng.uniform(-reach, reach, (task.n, task.joints))
    x = chain.positions(bend(q)) + task.sigma * rng.normal(size=(task.n, 3))
    wrong = round(task.outliers * task.n)
    directions = rng.normal(size=(wrong, 3))
    x[:wrong] += 0.2 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    start = time.process_time()
    learner.learn(q, x)
    seconds = time.process_time() - start
    test = rng.uniform(-test_reach, test_reach, (TEST_POSES, task.joints))
    estimate = learner.estimate(test)
    off = estimate.x - chain.positions(bend(test))
    lengths, ratios = np.linalg.norm(off, axis=1), np.abs(off) / estimate.sigma
    return Outcome(float(lengths.mean()), float(lengths.max()), seconds, *(float((ratios < k).mean()) for k in (1, 2)))


def show(name: str, task: Task, seeds: int) -> None:
    outcomes = [run(task, seed) for seed in range(seeds)]
    means, largest = [o.mean for o in outcomes], [o.largest for o in outcomes]
    seconds = [o.seconds for o in outcomes]
    if task.sigma == 0.0:
        exact = sum(value < EXACT_M for value in largest)
        errors = f"exact {exact}/{seeds}, largest error median {np.median(largest):.1e} worst {max(largest):.1e} m"
    else:
        covered = [100.0 * float(np.mean([getattr(o, k) for o in outcomes])) for k in ("within_one", "within_two")]
        errors = (
            f"mean error {1e3 * np.mean(means):.2f} (worst {1e3 * max(means):.2f}) mm, "
            f"1 / 2 sigma hold {covered[0]:.0f} / {covered[1]:.0f} %"
        )
    print(f"{name:44s} n={task.n:5d}: {errors}; {np.median(seconds):.2f} s CPU (worst {max(seconds):.2f})", flush=True)


ROUGH, MILD = (3.0, 15.0, 30.0), (2.0, 10.0, 30.0)


def exact(seeds: int) -> None:
    for joints, counts in ((6, (82, 95)), (7, (86, 98, 110)), (10, (150, 200))):
        for n in counts:
            show(f"from nothing, d={joints}", Task(joints, n), seeds)


def noisy(seeds: int) -> None:
    for joints, counts in ((6, (150, 300, 1000, 2200)), (7, (150, 300, 1000))):
        for n in counts:
            show(f"from nothing, d={joints}, sigma 10 mm", Task(joints, n, 0.01), seeds)
    for n in (10, 30, 100, 150, 300, 2200):
        show("rough prior, d=6, sigma 10 mm", Task(6, n, 0.01, prior=ROUGH), seeds)


def prior(seeds: int) -> None:
    for joints, counts in ((10, (87,)), (20, (183, 200)), (30, (279, 300))):
        for n in counts:
            show(f"rough prior, d={joints}", Task(joints, n, prior=ROUGH), seeds)


def cluster(seeds: int) -> None:
    for n in (120, 150):
        show("from nothing, d=7, +-5 deg to +-80 deg", Task(7, n, reach_deg=5.0), seeds)
        show("rough prior, d=7, +-5 deg to +-80 deg", Task(7, n, reach_deg=5.0, prior=ROUGH), seeds)
    for n in (300, 1000):
        task = Task(6, n, 0.01, reach_deg=20.0, prior=ROUGH)
        show("rough prior, d=6, +-20 to +-80, sigma 10 mm", task, seeds)


def bent(seeds: int) -> None:
    for kind in ("rigid", "eccentric", "gain"):
        for n in (100, 300, 1000, 3000):
            task = Task(6, n, 0.005, reach_deg=60.0, test_deg=60.0, prior=MILD, bend=kind)
            show(f"mild prior, d=6, {kind}, sigma 5 mm", task, seeds)


def outliers(seeds: int) -> None:
    for share in (0.0, 0.05, 0.15):
        for known, label in ((None, "from nothing"), (ROUGH, "rough prior")):
            task = Task(6, 200, 0.01, prior=known, outliers=share)
            show(f"{label}, d=6, {share:.0%} off by 200 mm", task, seeds)


def stream(seeds: int) -> None:
    """Learn a walk of 2 degrees a joint and pair, with an announced marker move of 200 mm; print errors and times."""
    names = ("after 600", "changed, 30", "changed, 100", "changed, 300")
    errors, times = np.zeros((seeds, len(names))), []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        chain = true_chain(6, rng)
        task = Task(6, 0, 0.005, prior=MILD)
        learner = learner_for(task, chain, rng, TensorSettings(window=600))
        q = walk(900, 6, rng)
        test = q[rng.integers(0, 900, TEST_POSES)] + np.radians(5.0) * rng.normal(size=(TEST_POSES, 6))
        for i, angles in enumerate(q):
            if i == 600:
                chain = chain.with_tool([0.0, 0.2, 0.0])
                learner.tool_changed(0.2)
            start = time.perf_counter()
            learner.learn(angles, chain.positions(angles) + 0.005 * rng.normal(size=3))
            times.append(time.perf_counter() - start)
            if i + 1 in (600, 630, 700, 900):
                column = (600, 630, 700, 900).index(i + 1)
                off = learner.predict(test) - chain.positions(test)
                errors[seed, column] = 1e3 * np.linalg.norm(off, axis=1).mean()
    for name, column in zip(names, errors.T, strict=True):
        print(f"stream, d=6, sigma 5 mm, {name:14s}: mean error {column.mean():.2f} (worst {column.max():.2f}) mm")
    print(f"a pair, refits included: {1e3 * np.mean(times):.2f} ms (worst {1e3 * max(times):.0f})")


def walk(n: int, joints: int, rng: np.random.Generator) -> FloatArray:
    """Return a path (n, joints) [rad] between random poses within +-80 degrees, 2 degrees RMS a joint and step."""
    q, goal = np.zeros(joints), np.zeros(joints)
    path = np.empty((n, joints))
    for row in path:
        while np.linalg.norm(goal - q) < np.radians(4.0):
            goal = rng.uniform(-np.radians(80.0), np.radians(80.0), joints)
        q = q + np.radians(2.0) * np.sqrt(joints) * (goal - q) / np.linalg.norm(goal - q)
        row[:] = q
    return path


def cost(seeds: int) -> None:
    for joints in (7, 15, 30):
        rng = np.random.default_rng(0)
        reach = np.full(joints, np.radians(80.0))
        train = TensorTrain.from_chain(random_chain(joints, rng), learning_bases(-reach, reach))
        batch = rng.uniform(-reach, reach, (1000, joints))
        one = best_time(partial(train.predict, batch[0]), seeds)
        rows = best_time(partial(train.predict, batch), seeds)
        slopes = best_time(partial(train.jacobian, batch[0]), seeds)
        print(f"d={joints:2d}: predict {1e6 * one:.0f} us, a row {1e3 * rows:.2f} us, Jacobian {1e6 * slopes:.0f} us")


def best_time(call: Callable[[], object], seeds: int, repeats: int = 50) -> float:
    """Return the best mean time of one call [s] over several runs."""
    times: list[float] = []
    for _ in range(max(seeds, 3)):
        start = time.perf_counter()
        for _ in range(repeats):
            call()
        times.append((time.perf_counter() - start) / repeats)
    return min(times)


PARTS = {part.__name__: part for part in (exact, noisy, prior, cluster, bent, outliers, stream, cost)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--only", choices=sorted(PARTS))
    arguments = parser.parse_args()
    for name, part in PARTS.items():
        if arguments.only in (None, name):
            part(arguments.seeds)


if __name__ == "__main__":
    main()
