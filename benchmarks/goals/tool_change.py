"""Rows on a tool change, with the daemon's learner but without its processes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.goals.goal import Figure, Row, at_least, at_most
from benchmarks.goals.study import Study, Values, mean
from benchmarks.humanoid_arm import guided_path
from benchmarks.peers.bound import bounds
from benchmarks.peers.problem import Problem
from benchmarks.peers.tasks import Trial
from benchmarks.rigid_learner import new_tool_error
from benchmarks.rough_arm import ROUGH, RoughArm, rough_arm
from bodyschema.interfaces.records import FloatArray, Pair, frozen_array
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.nominal import NominalModel
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.solver import DirectSolver
from kbmaps import ChainTolerances

_JOINTS = 6
_MOVED_M, _DEMO_MOVED_M = 0.2, 0.25
_SIGMA_M, _DEMO_SIGMA_M = 0.005, 0.003
_BEFORE, _DEMO_BEFORE = 300, 600
_DEMO_TOLERANCES = ChainTolerances(axes=np.radians(2.0), points=0.01, tool=0.03)
_NOTICED_WITHIN, _LOOKED = 3, 10
_DEMO_STAGES = (10, 30, 60)
_TEST_ROWS = 500
_NEAR_DEG = 3.0
_PERCENT = 100.0


@dataclass(frozen=True)
class _Arm:
    """An arm, the noise of its pairs, and the learner that learns them in order."""

    arm: RoughArm
    sigma: float
    learning: OnlineLearner
    rng: np.random.Generator

    @classmethod
    def new(cls, joints: int, tolerances: ChainTolerances, sigma: float, rng: np.random.Generator) -> _Arm:
        arm = rough_arm(joints, rng, tolerances)
        limit = np.full(joints, np.pi)
        nominal = NominalModel(arm.drawing, -limit, limit)
        return cls(arm, sigma, OnlineLearner(nominal, LearnerConfig(), DirectSolver()), rng)

    def with_moved_marker(self, by_m: float) -> _Arm:
        direction = self.rng.normal(size=3)
        change = self.arm.change.copy()
        change[self.arm.parameters.tool] += by_m * direction / np.linalg.norm(direction)
        return _Arm(RoughArm(self.arm.parameters, change), self.sigma, self.learning, self.rng)

    def teach(self, q: FloatArray) -> Iterable[int]:
        """Learn pairs, with all background work done after each; yield their number."""
        cov = frozen_array(self.sigma**2 * np.eye(3))
        first = self.learning.counters.last_seq + 1
        for k, (row, x) in enumerate(zip(q, self.arm.measured(q, self.sigma, self.rng), strict=True)):
            pair = Pair("simulated", first + k, 1, (first + k) / 30.0, "", frozen_array(row), frozen_array(x), cov)
            self.learning.learn(pair, pair.t)
            while self.learning.work():
                pass
            yield k + 1

    def error_mm(self, q: FloatArray) -> float:
        off = self.learning.snapshot.predict(q).x - self.arm.positions(q)
        return 1e3 * float(np.linalg.norm(off, axis=1).mean())


def _found(on_path: bool, seed: int) -> Values:
    """Run an unannounced tool change; return the pairs until detection, and the error within +-80° after ten pairs.

    Args:
        on_path: True for seven joints on a guided path, False for six at independent poses.
    """
    rng = np.random.default_rng(seed)
    before = _Arm.new(7 if on_path else _JOINTS, ROUGH, _SIGMA_M, rng)
    count = _BEFORE + _LOOKED
    path = guided_path(count, rng).q if on_path else before.arm.angles(count, 80, rng)
    q, q_after = np.split(path, [_BEFORE])
    test = before.arm.angles(_TEST_ROWS, 80, rng)
    list(before.teach(q))
    changes = before.learning.counters.changes
    after = before.with_moved_marker(_MOVED_M)
    noticed = _LOOKED + 1
    for pairs in after.teach(q_after):
        if after.learning.counters.changes > changes:
            noticed = min(noticed, pairs)
    return {
        "noticed": noticed,
        "in time": _PERCENT * (noticed <= _NOTICED_WITHIN),
        "after 10": after.error_mm(test),
        "bound": _bound_mm(after.arm, q, q_after, test),
        "false alarms": changes,
    }


def _bound_mm(arm: RoughArm, q: FloatArray, q_after: FloatArray, test: FloatArray) -> float:
    """Return the posterior error [mm] of the right model when the change is known.

    Args:
        arm: the arm with the new tool.
        q: poses with the old tool (n, d) [rad].
        q_after: poses with the new tool.
        test: poses at which the error is computed.
    """
    reach = np.full(arm.drawing.joints, np.pi)
    before, after = (
        Problem(
            poses,
            arm.positions(poses),
            -reach,
            reach,
            np.random.default_rng(0),
            sigma=_SIGMA_M,
            drawing=arm.drawing,
            tolerances=ROUGH,
            tool_move=_MOVED_M,
        )
        for poses in (q, q_after)
    )
    return 1e3 * bounds(Trial(after, {"test": (test, arm.positions(test))}, before, arm))["test"]


def _told(seed: int) -> Values:
    return {"after 10": new_tool_error(seed)}


def _demo(seed: int) -> Values:
    """Run the demo on a guided path: an announced tool change; return errors near the poses visited since."""
    rng = np.random.default_rng(seed)
    before = _Arm.new(7, _DEMO_TOLERANCES, _DEMO_SIGMA_M, rng)
    q, q_after = np.split(guided_path(_DEMO_BEFORE + _DEMO_STAGES[-1], rng).q, [_DEMO_BEFORE])
    list(before.teach(q))
    after = before.with_moved_marker(_DEMO_MOVED_M)
    after.learning.tool_changed()
    values: dict[str, float] = {}
    for pairs in after.teach(q_after):
        if pairs in _DEMO_STAGES:
            near = q_after[rng.integers(pairs, size=_TEST_ROWS)]
            near = near + np.radians(_NEAR_DEG) * rng.normal(size=near.shape)
            values[f"after {pairs}"] = after.error_mm(near)
    return values


def rows() -> list[Row]:
    found = (Study(f"tool change found, poses drawn, {_BEFORE} pairs before", partial(_found, False)),)
    walking = (Study(f"tool change found on a guided path, {_BEFORE} pairs before", partial(_found, True)),)
    told = (Study("tool change told, recursive rigid chain", _told, seeds=200),)
    demo = (Study("tool change on a guided path", _demo),)
    return [
        Row(
            "tool",
            "tool moved by 200 mm while running, σ = 5 mm, rough nominal model",
            (
                Figure(
                    "the daemon's learner, change unknown, guided path, d = 7: share of seeds detected within 3 pairs",
                    walking,
                    mean("in time"),
                    at_least(95.0, "%"),
                ),
                Figure(
                    "the same, random poses within ±80°, d = 6: share of seeds detected within 3 pairs",
                    found,
                    mean("in time"),
                    at_least(95.0, "%"),
                ),
                Figure("the same: pairs until detected", found, mean("noticed"), at_most(3.0, "pairs")),
                Figure("the same: false alarms per seed", found, mean("false alarms"), at_most(0.0)),
                Figure("the same: error after 10 pairs", found, mean("after 10"), at_most(3.0, "mm"), mean("bound")),
                Figure(
                    "recursive rigid chain, change known: error after 10 pairs",
                    told,
                    mean("after 10"),
                    at_most(3.0, "mm"),
                ),
            ),
        ),
        Row(
            "demo",
            "the demo (d = 7, nominal model off by 2°, 10 mm, 30 mm, σ = 3 mm, tool moved by 250 mm)",
            (Figure("60 pairs after the change, near the path", demo, mean("after 60"), at_most(5.0, "mm")),),
        ),
    ]
