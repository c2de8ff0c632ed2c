"""Coverage of the models' predictive uncertainty: `python -m benchmarks.coverage [--seeds N]`.

Per task and model, at held-out poses: the share of coordinates of the true position within 1 and within 1.96 claimed
sigmas of the prediction (mean over the seeds, with its standard error), and the mean error. The goal is 66 to 70 % and
93 to 97 %; where the model is wrong and has to extrapolate, at least 60 and 85 %. "!" marks a share that misses its
goal by more than two standard errors. Arm, nominal model and noise are those of benchmarks.rigid_learner.

Tasks and models are selected by a part of their name: `--tasks "d=6" sag --models batch`.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.bent_arm import RIGID, bent
from benchmarks.humanoid_arm import guided_path
from benchmarks.rough_arm import ROUGH, RoughArm, rough_arm
from kbmaps import (
    Model,
    RecursiveRigidLearner,
    ResidualLearner,
    RigidLearner,
    TensorLearner,
    TensorSettings,
    learning_bases,
)
from kbmaps.arrays import FloatArray
from kbmaps.planning.design import mean_distances

SIGMA = 0.01
TEST_ROWS = 500
OUTLIERS_OFF_M = 0.2
NEW_TOOL_M, NEW_TOOL_PAIRS = 0.2, 30
ONE_SIGMA_GOAL, TWO_SIGMA_GOAL = (0.66, 0.70), (0.93, 0.97)
BENT_GOAL = (0.60, 0.85)


@dataclass(frozen=True)
class Task:
    """Training data and test poses of one case.

    Attributes:
        joints: 6 or 7.
        pairs: number of pairs.
        told: True if the learner is given the noise.
        reach_deg: half the range of independent poses; 0 for a guided path.
        around_deg: half the range of the random centre of those poses.
        test_deg: half the range of the test poses.
        bend: kind of non-rigid effect, as in `bent`.
        outliers: share of the pairs that are off by 200 mm.
        new_tool: True if the marker is then moved by 200 mm and 30 more pairs are taken.
    """

    joints: int
    pairs: int
    told: bool = False
    reach_deg: float = 80.0
    around_deg: float = 0.0
    test_deg: float = 80.0
    bend: str = RIGID
    outliers: float = 0.0
    new_tool: bool = False

    @property
    def name(self) -> str:
        parts = [f"d={self.joints} n={self.pairs} {'told' if self.told else 'found'}"]
        if not self.reach_deg:
            parts.append("walk")
        elif self.around_deg:
            parts.append(f"zone {self.reach_deg:.0f}")
        if self.bend != RIGID:
            parts.append(self.bend)
        if self.reach_deg != self.test_deg:
            parts.append(f"{'' if not self.reach_deg else f'{self.reach_deg:.0f} '}to {self.test_deg:.0f}")
        if self.outliers:
            parts.append(f"outliers {self.outliers:.0%}")
        if self.new_tool:
            parts.append("new tool")
        return ", ".join(parts)


def tasks() -> list[Task]:
    sizes = (30, 100, 300, 1000)
    found = [Task(d, n, told) for d in (6, 7) for told in (True, False) for n in sizes]
    found += [Task(7, n, told, 0.0, test_deg=60.0) for told in (True, False) for n in sizes]
    found += [Task(6, n, told, 20.0, 60.0) for told in (True, False) for n in (30, 300)]
    found += [Task(6, n, told, outliers=0.15) for told in (True, False) for n in (30, 100, 300)]
    found += [Task(6, 300, told, new_tool=True) for told in (True, False)]
    for kind in ("sag", "eccentric", "gain", "affine", "radial"):
        found += [Task(6, n, told, bend=kind) for told in (True, False) for n in (100, 1000)]
        found += [Task(6, n, told, 40.0, bend=kind) for told in (True, False) for n in (100, 1000)]
    return found


@dataclass(frozen=True)
class Entry:
    """A model under test: its constructor from a nominal model, and its tool-change call, if it has one."""

    make: Callable[[RoughArm, Task], Model]
    new_tool: Callable[[Model], None] | None = None


def _tensor(arm: RoughArm, task: Task) -> TensorLearner:
    reach = np.full(task.joints, np.radians(80.0))
    settings = TensorSettings(refit_every=10 * task.pairs)
    return TensorLearner.around(arm.drawing, learning_bases(-reach, reach), settings)


def _tell_recursive(model: Model) -> None:
    if isinstance(model, RecursiveRigidLearner):
        model.tool_changed(NEW_TOOL_M)


def _tell_tensor(model: Model) -> None:
    if isinstance(model, TensorLearner):
        model.tool_changed(NEW_TOOL_M)


MODELS: dict[str, Entry] = {
    "rigid, batch": Entry(lambda arm, _: RigidLearner(arm.drawing, ROUGH)),
    "rigid, recursive": Entry(lambda arm, _: RecursiveRigidLearner(arm.drawing, ROUGH), _tell_recursive),
    "tensor train": Entry(_tensor, _tell_tensor),
    "residual": Entry(lambda arm, _: ResidualLearner(arm.drawing, ROUGH)),
}


@dataclass(frozen=True)
class Outcome:
    """Shares of coordinates within 1 and 1.96 sigma, mean error [m], and the mean error that was claimed [m]."""

    one: float
    two: float
    error: float
    claimed: float


def poses(task: Task, arm: RoughArm, rng: np.random.Generator) -> FloatArray:
    if not task.reach_deg:
        return guided_path(task.pairs, rng).q[:, : task.joints]
    centre = rng.uniform(-task.around_deg, task.around_deg, task.joints)
    return arm.angles(task.pairs, task.reach_deg, rng, centre)


def run(task: Task, entry: Entry, seed: int) -> Outcome:
    rng = np.random.default_rng(seed)
    arm = bent(rough_arm(task.joints, rng), task.bend, rng)
    model, told = entry.make(arm, task), SIGMA if task.told else None
    q = poses(task, arm, rng)
    x = arm.measured(q, SIGMA, rng)
    wrong = rng.permutation(len(q))[: round(task.outliers * len(q))]
    directions = rng.normal(size=(len(wrong), 3))
    x[wrong] += OUTLIERS_OFF_M * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    model.learn(q, x, told)
    refit(model)
    if task.new_tool and entry.new_tool is not None:
        moved = arm.change.copy()
        moved[arm.parameters.tool] += NEW_TOOL_M / math.sqrt(3.0) * rng.normal(size=3)
        arm = RoughArm(arm.parameters, moved)
        entry.new_tool(model)
        q = arm.angles(NEW_TOOL_PAIRS, task.reach_deg, rng)
        model.learn(q, arm.measured(q, SIGMA, rng), told)
        refit(model)
    test = arm.angles(TEST_ROWS, task.test_deg, rng)
    estimate = model.estimate(test)
    off = estimate.x - arm.positions(test)
    ratios = np.abs(off) / estimate.sigma
    return Outcome(
        float((ratios < 1.0).mean()),
        float((ratios < 1.96).mean()),
        float(np.linalg.norm(off, axis=1).mean()),
        float(mean_distances(np.square(estimate.sigma)[:, :, None] * np.eye(3)).mean()),
    )


def refit(model: Model) -> None:
    """Refit a tensor train to all its pairs; other models are left unchanged."""
    if isinstance(model, TensorLearner):
        model.refit()


def verdict(task: Task, ones: FloatArray, twos: FloatArray) -> str:
    extrapolates = task.bend != RIGID and task.reach_deg < task.test_deg
    marks = ""
    for shares, goal, least in ((ones, ONE_SIGMA_GOAL, BENT_GOAL[0]), (twos, TWO_SIGMA_GOAL, BENT_GOAL[1])):
        low, high = (least, 1.0) if extrapolates else goal
        doubt = 2.0 * float(shares.std()) / math.sqrt(len(shares))
        mean = float(shares.mean())
        marks += "!" if mean + doubt < low or mean - doubt > high else ""
    return marks


def report(task: Task, outcomes: list[Outcome], seconds: float) -> None:
    seeds = len(outcomes)
    ones, twos = np.array([o.one for o in outcomes]), np.array([o.two for o in outcomes])
    cells = [f"{100.0 * s.mean():5.1f} ({100.0 * s.std() / math.sqrt(seeds):.1f})" for s in (ones, twos)]
    error, claimed = 1e3 * np.mean([(o.error, o.claimed) for o in outcomes], axis=0)
    took = f"{seconds / seeds:.2f}"
    print(
        f"  {task.name:36s}{'  '.join(cells)}  {error:6.2f} {claimed:6.2f}  {took}  {verdict(task, ones, twos)}",
        flush=True,
    )


def chosen(name: str, parts: list[str]) -> bool:
    return not parts or any(part in name for part in parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="the goal is over 200")
    parser.add_argument("--tasks", nargs="+", default=[], help="parts of their names")
    parser.add_argument("--models", nargs="+", default=[], help="parts of their names")
    arguments = parser.parse_args()
    seeds: int = arguments.seeds
    for name, entry in MODELS.items():
        if not chosen(name, arguments.models):
            continue
        print(f"\n{name}, {seeds} seeds: within 1 and 1.96 sigma (standard error) [%]; error, claimed [mm]; s a seed")
        for task in tasks():
            if chosen(task.name, arguments.tasks) and (entry.new_tool is not None or not task.new_tool):
                begin = time.perf_counter()
                outcomes = [run(task, entry, seed) for seed in range(seeds)]
                report(task, outcomes, time.perf_counter() - begin)


if __name__ == "__main__":
    main()
