"""Errors and uncertainty of the learner with few pairs: `python -m benchmarks.first_pairs [--seeds N] [--only PART]`.

Arms of four, six and seven joints are guided along a path. Their nominal models err by half, once and twice the
learner's tolerances. The frame is known, or the camera's pose is unknown, or the marker's position is unknown too. Each
seed selects a noise of 0.3, 3 or 10 mm and one of the nominal errors. An announced tool change follows the last stage.
Printed per stage: mean distance to the truth, mean length of the claimed sigma [mm], share of coordinates within one
and 1.96 sigma [%], and how often each model answered. "near" are poses within three degrees a joint of the path,
"anywhere" those within the limits of 90 degrees.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.rough_arm import rough_arm
from bodyschema.interfaces.records import Pair, frozen_array
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import NominalModel, chain_tolerances
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver
from kbmaps import RigidChain
from kbmaps.arrays import FloatArray

JOINTS = (4, 6, 7)
NOISES_M = (0.0003, 0.003, 0.01)
DRAWINGS = (0.5, 1.0, 2.0)
FRAMES = {"known": (True, True), "pose unknown": (False, True), "pose and marker unknown": (False, False)}
KNOWN_STAGES, STAGES, TOOL_STAGES = (0, 1, 2, 5, 12, 20, 40, 100, 300), (12, 20, 40, 100, 300), (3, 10, 40)
LIMIT, REACH, STEP = np.radians(90.0), np.radians(60.0), np.radians(2.0)
POSES = 300
# Distance of unknown poses from the nominal ones: far beyond any tolerance.
POSE_RAD, POSE_M, MARKER_M, TOOL_M = 0.5, 0.3, 0.1, 0.25


@dataclass(frozen=True)
class Case:
    """One arm and its pairs."""

    joints: int
    frame: str
    noise_m: float
    drawing: float
    seed: int


@dataclass(frozen=True)
class Outcome:
    """Predictions at one stage.

    Attributes:
        error: mean distance to the truth [m].
        claimed: mean length of sigma [m].
        one, two: shares of coordinates within one and 1.96 sigma.
    """

    stage: str
    where: str
    answering: str
    error: float
    claimed: float
    one: float
    two: float


def guided(joints: int, count: int, rng: np.random.Generator) -> FloatArray:
    """Return straight segments between random waypoints in steps of 2 degrees, shape (count, joints)."""
    q, goal = [np.zeros(joints)], rng.uniform(-REACH, REACH, joints)
    while len(q) < count:
        if np.linalg.norm(goal - q[-1]) < STEP:
            goal = rng.uniform(-REACH, REACH, joints)
        way = goal - q[-1]
        q.append(q[-1] + STEP * way / np.linalg.norm(way))
    return np.array(q)


def elsewhere(built: RigidChain, frame: str, rng: np.random.Generator) -> RigidChain:
    """Return the arm with a random tool or camera pose, whichever `frame` leaves unknown."""
    pose_known, marker_known = FRAMES[frame]
    if not marker_known:
        built = built.with_tool(MARKER_M * rng.normal(size=3))
    if not pose_known:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(POSE_RAD * rng.normal(size=3)).as_matrix()
        pose[:3, 3] = POSE_M * rng.normal(size=3)
        built = built.transformed(pose)
    return built


def outcomes(case: Case, pairs: int) -> Iterator[Outcome]:
    """Teach one arm, with all background work done after each pair; yield the outcome of each stage."""
    rng = np.random.default_rng(case.seed)
    settings = LearnerConfig()
    arm = rough_arm(case.joints, rng, chain_tolerances(settings))
    built = elsewhere(arm.parameters.chain(case.drawing * arm.change), case.frame, rng)
    limit = np.full(case.joints, LIMIT)
    learning = OnlineLearner(NominalModel(arm.drawing, -limit, limit, *FRAMES[case.frame]), settings, DirectSolver())
    stages = [stage for stage in (KNOWN_STAGES if case.frame == "known" else STAGES) if stage <= pairs]
    q = guided(case.joints, stages[-1] + TOOL_STAGES[-1], rng)
    if 0 in stages:
        yield from looked(learning, built, q[:1], "0", rng)
    for count in range(1, stages[-1] + 1):
        teach(learning, case, built, q[count - 1], rng)
        if count in stages:
            yield from looked(learning, built, q[:count], str(count), rng)
    direction = rng.normal(size=3)
    built = built.with_tool(TOOL_M * direction / np.linalg.norm(direction))
    learning.tool_changed()
    for count in range(1, TOOL_STAGES[-1] + 1):
        teach(learning, case, built, q[stages[-1] + count - 1], rng)
        if count in TOOL_STAGES:
            yield from looked(learning, built, q[stages[-1] :][:count], f"+{count}", rng)


def teach(learning: OnlineLearner, case: Case, built: RigidChain, q: FloatArray, rng: np.random.Generator) -> None:
    seq = learning.counters.last_seq + 1
    x = built.positions(q) + case.noise_m * rng.normal(size=3)
    cov = frozen_array(case.noise_m**2 * np.eye(3))
    learning.learn(Pair("simulated", seq, 1, seq / 30.0, "", frozen_array(q), frozen_array(x), cov), seq / 30.0)
    while learning.work():
        pass


def looked(
    learning: OnlineLearner, built: RigidChain, path: FloatArray, stage: str, rng: np.random.Generator
) -> Iterator[Outcome]:
    snapshot, joints = learning.snapshot, path.shape[1]
    if snapshot.model is None:
        return
    near = path[rng.integers(len(path), size=POSES)] + rng.normal(0.0, np.radians(3.0), (POSES, joints))
    for where, q in (("near", near), ("anywhere", rng.uniform(-LIMIT, LIMIT, (POSES, joints)))):
        told, truth = snapshot.predict(q), built.positions(q)
        off = np.abs(told.x - truth)
        yield Outcome(
            stage=stage,
            where=where,
            answering=snapshot.answering,
            error=float(np.linalg.norm(off, axis=1).mean()),
            claimed=float(np.linalg.norm(told.sigma, axis=1).mean()),
            one=float((off < told.sigma).mean()),
            two=float((off < 1.96 * told.sigma).mean()),
        )


def cases(seeds: int, first: int, only: str, joints: tuple[int, ...]) -> Iterator[Case]:
    """Yield the cases; nine seeds cover each combination of noise and nominal error once."""
    for frame in FRAMES:
        for d in joints:
            for seed in range(first, first + seeds):
                noise, drawing = NOISES_M[seed % 3], DRAWINGS[seed // 3 % 3]
                if only in frame:
                    yield Case(d, frame, noise, drawing, seed)


def report(found: dict[tuple[str, str, str], list[Outcome]]) -> None:
    print(f"  {'frame':24s}{'stage':6s}{'where':9s}{'n':>4s} {'error':>7s} {'claimed':>8s} {'1 s':>4s} {'1.96 s':>6s}")
    for (frame, stage, where), some in found.items():
        mean = {name: np.mean([getattr(each, name) for each in some]) for name in ("error", "claimed", "one", "two")}
        answering = ", ".join(f"{name} {n}" for name, n in Counter(each.answering for each in some).most_common())
        print(
            f"  {frame:24s}{stage:6s}{where:9s}{len(some):4d} {1e3 * mean['error']:7.1f} {1e3 * mean['claimed']:8.1f} "
            f"{100 * mean['one']:4.0f} {100 * mean['two']:6.0f}  {answering}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=9, help="of each frame and number of joints")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--pairs", type=int, default=STAGES[-1], help="go no further before the tool is changed")
    parser.add_argument("--only", default="", help="a part of the frame's name")
    parser.add_argument("--joints", type=int, nargs="+", default=list(JOINTS))
    parser.add_argument("--by", choices=("all", "joints", "noise_m", "drawing"), default="all")
    arguments = parser.parse_args()
    found: dict[str, dict[tuple[str, str, str], list[Outcome]]] = defaultdict(lambda: defaultdict(list))
    for case in cases(arguments.seeds, arguments.first, arguments.only, tuple(arguments.joints)):
        group = "all" if arguments.by == "all" else f"{arguments.by} {getattr(case, arguments.by)}"
        for outcome in outcomes(case, arguments.pairs):
            found[group][case.frame, outcome.stage, outcome.where].append(outcome)
    for group, cells in found.items():
        print(f"{group}: errors and claims [mm], coordinates within so many sigma [%], who answered how often")
        report(cells)


if __name__ == "__main__":
    main()
