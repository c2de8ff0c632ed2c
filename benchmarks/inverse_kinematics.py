"""Inverse kinematics on random arms: how often targets are reached, steps, and time.

Targets are positions (and poses) of random configurations within the limits, so all of them are in reach; then
positions that certainly are not. Arms have random link lengths and axes. No initial guess is given: every answer is
found globally.
Run: python benchmarks/inverse_kinematics.py
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from kbmaps import InverseKinematics, KBMap, RigidChain, learning_bases

LINK_M = 0.15
STROKE_M = 0.3
BEYOND_M = 0.2


@dataclass(frozen=True)
class Case:
    """One row: joints (R revolute, P prismatic), half range of the revolute ones [deg], positions or poses."""

    kinds: str
    half_deg: float
    pose: bool


CASES = [
    Case("RRR", 100, False),
    Case("RRPR", 100, False),
    Case("RRRRRRR", 30, False),
    Case("RRRRRRR", 100, False),
    Case("RRRRRRR", 170, False),
    Case("RRRRRRRRR", 100, False),
    Case("RRRRRR", 100, True),
    Case("RRRRRR", 170, True),
    Case("RRRRRRR", 30, True),
    Case("RRRRRRR", 100, True),
    Case("RRPRRRR", 100, True),
]


def random_arm(rng: np.random.Generator, case: Case) -> tuple[KBMap, np.ndarray]:
    """Return a random arm as a pose map, and its half ranges (d,) [rad or m]."""
    d = len(case.kinds)
    slides = np.array([kind == "P" for kind in case.kinds])
    fixed = np.tile(np.eye(4), (d + 1, 1, 1))
    fixed[:, :3, :3] = Rotation.random(d + 1, rng=rng).as_matrix()
    fixed[:, :3, 3] = LINK_M * rng.normal(size=(d + 1, 3))
    axes = rng.normal(size=(d, 3))
    chain = RigidChain(fixed, axes / np.linalg.norm(axes, axis=1, keepdims=True), slides)
    half = np.where(slides, STROKE_M, np.radians(case.half_deg))
    return chain.to_kbmap(learning_bases(-half, half, slides.tolist()), orientation=case.pose), half


def farthest(kbmap: KBMap, half: np.ndarray, rng: np.random.Generator) -> float:
    """Return a distance [m] from the base that no configuration reaches: more than twice the farthest sample."""
    reach = np.linalg.norm(kbmap.predict(rng.uniform(-half, half, (4000, len(half)))), axis=1).max()
    return 2.0 * float(reach) + BEYOND_M


def measure(case: Case, arms: int, targets: int) -> None:
    converged, steps, starts, times, told, far_times = [], [], [], [], [], []
    for seed in range(arms):
        rng = np.random.default_rng(seed)
        kbmap, half = random_arm(rng, case)
        solver = InverseKinematics(kbmap, -half, half, seed=seed)
        solver.solve(kbmap.predict(np.zeros(len(half))), kbmap.orientation(np.zeros(len(half))) if case.pose else None)
        for truth in rng.uniform(-half, half, (targets, len(half))):
            x, rotation = kbmap.predict(truth), kbmap.orientation(truth) if case.pose else None
            begin = time.perf_counter()
            found = solver.solve(x, rotation)
            times.append(time.perf_counter() - begin)
            converged.append(found.converged and np.linalg.norm(kbmap.predict(found.q) - x) < 1e-6)
            steps.append(found.steps)
            starts.append(found.starts)
        direction = rng.normal(size=3)
        outside = farthest(kbmap, half, rng) * direction / np.linalg.norm(direction)
        begin = time.perf_counter()
        found = solver.solve(outside, np.eye(3) if case.pose else None)
        far_times.append(time.perf_counter() - begin)
        told.append(found.reason == "out_of_reach")
    milliseconds = 1e3 * np.array(times)
    print(
        f"| {case.kinds} | {case.half_deg:.0f} | {'pose' if case.pose else 'position'} "
        f"| {100 * np.mean(converged):.2f} % "
        f"| {np.median(steps):.0f} / {np.percentile(steps, 99):.0f} | {100 * np.mean(np.array(starts) == 1):.0f} % "
        f"| {np.median(milliseconds):.1f} / {np.percentile(milliseconds, 99):.0f} "
        f"| {100 * np.mean(told):.0f} % | {1e3 * np.median(far_times):.0f} |",
        flush=True,
    )


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arms", type=int, default=20)
    parser.add_argument("--targets", type=int, default=50, help="of each arm")
    options = parser.parse_args()
    print(f"{options.arms} random arms, {options.targets} targets each")
    print("time [ms] and steps: median / 99 %")
    print(
        "| joints | half range [deg] | target | reached | steps | first start | time | outside: told | time of that |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for case in CASES:
        measure(case, options.arms, options.targets)


if __name__ == "__main__":
    main()
