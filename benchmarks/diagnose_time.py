"""Cost of a diagnosis: `python -m benchmarks.diagnose_time [--pairs 1600] [--times 10] [--causes 1 2 3 5]`.

The arm of the shipped upper body (six joints and the eyes) follows a random walk. Effects of the table are put into its
simulation, with pixel noise and encoder quantisation added. All hypotheses are tried. Each case runs in its own
process: seconds are CPU time, independent of other programs, and memory is the process's peak. Ratios compare `--times`
as many pairs with `--pairs`.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from bodyschema.cli.recordings.synthesis import simulated, with_noise
from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.page import About, page
from bodyschema.diagnosis.report.text import remedies
from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.toml_file import read_toml
from bodyschema.sim_backend import model_file
from kbmaps.arrays import BoolArray

JOINTS = (
    "neck_yaw",
    "shoulder_flexion",
    "shoulder_abduction",
    "upperarm_rotation",
    "elbow_flexion",
    "forearm_rotation",
)
# In this order they are hidden.
HIDDEN: tuple[tuple[str, str | None, tuple[float, ...]], ...] = (
    ("joint_compliance", "shoulder_flexion", (0.002,)),
    ("joint_eccentricity", "elbow_flexion", (0.01, 0.008)),
    ("backlash", "upperarm_rotation", (0.02,)),
    ("link_geometry", "forearm_rotation", (0.004, 0.0, 0.003, 0.0, 0.02, 0.0)),
    ("joint_scale", "shoulder_abduction", (0.02,)),
)
INTERVAL_S, STEP_RAD, TICKS_A_TURN = 0.1, 0.04, 4096
# A pose in which the ball is well in front of the eyes, and how far from it the walk goes [rad].
CENTRE_RAD, SPREAD_RAD = (-0.9, 1.05, 0.8, 0.15, 0.9, 0.0), 0.5
# The walk has this many times the wanted rows, because the cameras do not see all of them.
SPARE, NEAREST_M, MARGIN_PX = 6, 0.2, 20.0


@dataclass(frozen=True)
class Cost:
    """Cost of one diagnosis: CPU seconds to find and to report, peak memory, and the causes named."""

    found_s: float
    told_s: float
    peak_mb: float
    named: tuple[str, ...]

    @property
    def total_s(self) -> float:
        return self.found_s + self.told_s


def arm() -> RobotDescription:
    """Load the arm and cameras of the upper body, held by its own motors."""
    tables, text = read_toml(model_file("upper_body"))
    tables["robot"] |= {"joints": list(JOINTS), "hold": "held"}
    tables["robot"]["held_at"] |= {"neck_pitch": 0.35}
    return RobotDescription.from_tables(tables, text, model_file("upper_body"))


def walk(robot: RobotDescription, pairs: int, rng: np.random.Generator) -> Motion:
    """Return a random walk in front of the cameras: readings (n, d) [rad] in whole ticks, visible rows only."""
    centre, joints = np.array(CENTRE_RAD), len(robot.joints)
    q, at, heading = np.empty((SPARE * pairs, joints)), centre, np.zeros(joints)
    for row in range(len(q)):
        heading = 0.9 * heading + rng.normal(size=joints)
        at = np.clip(at + STEP_RAD * heading / np.sqrt(joints), centre - SPREAD_RAD, centre + SPREAD_RAD)
        q[row] = at
    tick = 2.0 * np.pi / TICKS_A_TURN
    q = np.round(q / tick) * tick
    t: FloatArray = np.asarray(INTERVAL_S * np.arange(len(q)), dtype=np.float64)
    everywhere = Motion(q, t, np.zeros(len(q), dtype=np.int64))
    seen = np.flatnonzero(in_view(robot, Simulation(robot).positions(everywhere)))[:pairs]
    return Motion(q[seen], t[seen], np.cumsum(np.append(0, np.diff(seen) > 1)))


def in_view(robot: RobotDescription, x: FloatArray) -> BoolArray:
    """Return True for each position (n, 3) [m] that lies well inside the left camera's image."""
    calibration = robot.calibration
    assert calibration is not None
    centre, size = np.array(calibration.principal_point_px), np.array(calibration.image_size_px)
    pixels = calibration.focal_px * x[:, :2] / np.maximum(x[:, 2:], NEAREST_M) + centre
    inside = (pixels > MARGIN_PX) & (pixels < size - MARGIN_PX)
    return inside.all(axis=1) & (x[:, 2] > NEAREST_M)


def recording(robot: RobotDescription, pairs: int, causes: int, seed: int) -> Recording:
    """Simulate a measured walk of the arm with the first `causes` of the hidden effects."""
    rng = np.random.default_rng(seed)
    motion = walk(robot, pairs, rng)
    effects = tuple(Effect.at(robot, name, joint, None, values) for name, joint, values in HIDDEN[:causes])
    exact = Recording(joints=robot.joints, q=motion.q, x=np.zeros((pairs, 3)), t=motion.t, segment=motion.segment)
    simulation = Simulation(robot, effects)
    exact = simulated(simulation, exact)
    return with_noise(simulation, exact, exact, rng)


def cost(pairs: int, causes: int, seed: int) -> Cost:
    """Diagnose one recording, and write its report."""
    robot = arm()
    measured = recording(robot, pairs, causes, seed)
    start = time.process_time()
    diagnosis = diagnose(measured, Simulation(robot), seed=seed)
    found = time.process_time()
    file = conclusion(diagnosis)
    page(diagnosis, file, remedies(file, robot, *np.zeros((2, len(JOINTS)))), About("walk", robot.robot.name, "0"))
    told = time.process_time()
    named = tuple(f"{c.effect} at {c.where}" if c.where else c.effect for c in file.causes)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return Cost(found - start, told - found, peak_mb, named)


def in_own_process(pairs: int, causes: int, seed: int) -> Cost:
    """Run `cost` in its own process, so that its memory peak is separate."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(cost, pairs, causes, seed).result()


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=1600)
    parser.add_argument("--times", type=int, default=10)
    parser.add_argument("--causes", type=int, nargs="+", default=[1, 2, 3, 5], choices=range(len(HIDDEN) + 1))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    print("hidden   pairs  find [s]  tell [s]  peak [MB]   named")
    for causes in args.causes:
        costs = []
        for pairs in dict.fromkeys((args.pairs, args.times * args.pairs)):
            costs.append(spent := in_own_process(pairs, causes, args.seed))
            head = f"{causes:6d} {pairs:7d} {spent.found_s:9.2f} {spent.told_s:9.2f} {spent.peak_mb:10.0f}"
            print(f"{head}   {', '.join(spent.named) or 'nothing'}", flush=True)
        if len(costs) == 2:
            few, many = costs
            time_ratio, peak_ratio = many.total_s / few.total_s, many.peak_mb / few.peak_mb
            print(f"{'':6} x {args.times:5d}: time x {time_ratio:.1f}, peak x {peak_ratio:.1f}", flush=True)


if __name__ == "__main__":
    main()
