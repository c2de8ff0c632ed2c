"""The tasks: arm, pairs and test poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.peers.problem import Measure, Problem
from benchmarks.peers.truths import Affine, Arm, Eccentric, GearGain, Radial, Sag
from benchmarks.rough_arm import ROUGH, RoughArm, rough_arm
from benchmarks.tensor_train import random_chain
from kbmaps import ChainParameters, ChainTolerances
from kbmaps.arrays import FloatArray

COUNTS = (30, 100, 300, 1000, 3000)
TEST_POSES = 500
# Draws a non-rigid effect for an arm with this number of joints.
Effect = Callable[[int, np.random.Generator], Eccentric | GearGain | Sag | Affine | Radial | None]
MILD = ChainTolerances(axes=math.radians(2.0), points=0.01, tool=0.03)
HUMANOID_JOINTS = 7
PAIRS_BEFORE = 600
ZONE_CENTRE_DEG = 60.0


@dataclass(frozen=True, eq=False)
class Trial:
    """One seed of a task: pairs to learn, also those before a tool change, and tests.

    Attributes:
        tests: name -> (poses (k, d) [rad], true positions (k, 3) [m]).
        arm: the nominal model and the true arm; None for recordings.
    """

    problem: Problem
    tests: dict[str, tuple[FloatArray, FloatArray]]
    before: Problem | None = None
    arm: RoughArm | None = None


@dataclass(frozen=True)
class Task:
    """One panel of the page.

    Attributes:
        key, title: short and long name.
        trial: samples the seed's trial with n pairs; returns None if there are fewer.
        counts: numbers of pairs.
        goals: pairs -> target figure [m]; the goal is that or 1.15 times the bound, whichever is larger.
        note: special features.
    """

    key: str
    title: str
    trial: Callable[[int, int], Trial | None]
    counts: tuple[int, ...] = COUNTS
    goals: dict[int, float] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True)
class Setting:
    """Distribution of simulated trials; angles in degrees.

    Attributes:
        joints: number of joints; up to 7 the humanoid arm without its last joints, above that a random chain.
        drawn: True if the learner gets the nominal model.
        zone: half the range of the pairs about a random centre; None for the whole range.
        effect: samples the arm's non-rigid effect.
        tool_move: distance by which the marker moves after 600 pairs [m].
    """

    joints: int = 6
    sigma: float = 0.01
    reach: float = 80.0
    tolerances: ChainTolerances = ROUGH
    drawn: bool = True
    zone: float | None = None
    effect: Effect = lambda _joints, _rng: None
    tool_move: float | None = None

    def __call__(self, seed: int, pairs: int) -> Trial:
        rng = np.random.default_rng(seed)
        built = self._arm(rng)
        arm = self._truth(built, rng)
        reach = np.full(self.joints, math.radians(self.reach))
        tests = {"drawn alike": rng.uniform(-reach, reach, (TEST_POSES, self.joints))}
        centre, half = np.zeros(self.joints), reach
        if self.zone is not None:
            half = np.full(self.joints, math.radians(self.zone))
            centre = np.radians(rng.uniform(-ZONE_CENTRE_DEG, ZONE_CENTRE_DEG, self.joints))
            tests = {"drawn alike": rng.uniform(centre - half, centre + half, tests["drawn alike"].shape)} | {
                "extrapolated": tests["drawn alike"]
            }
        # Fewer pairs of a seed are a prefix of more; the noise of requested readings has its own stream.
        before = None
        if self.tool_move is not None:
            before = self._problem(arm, built, PAIRS_BEFORE, centre, half, reach, seed)
            direction = rng.normal(size=3)
            built, arm = _with_tool(built, arm, self.tool_move * direction / np.linalg.norm(direction))
        problem = self._problem(arm, built, pairs, centre, half, reach, seed + (before is not None) * 1_000_000)
        shown = {name: (q, arm.positions(q)) for name, q in tests.items()}
        problem = replace(problem, tool_move=self.tool_move)
        return Trial(problem, shown, before, built if arm.joint_effect is arm.camera_effect is None else None)

    def _arm(self, rng: np.random.Generator) -> RoughArm:
        if self.joints <= HUMANOID_JOINTS:
            return rough_arm(self.joints, rng, self.tolerances)
        parameters = ChainParameters(random_chain(self.joints, rng))
        return RoughArm(parameters, parameters.standard_deviations(self.tolerances) * rng.normal(size=parameters.size))

    def _truth(self, built: RoughArm, rng: np.random.Generator) -> Arm:
        effect = self.effect(self.joints, rng)
        chain = built.parameters.chain(built.change)
        if isinstance(effect, Affine | Radial):
            return Arm.of(chain, camera_effect=effect)
        return Arm.of(chain, joint_effect=effect)

    def _problem(
        self, arm: Arm, built: RoughArm, pairs: int, centre: FloatArray, half: FloatArray, reach: FloatArray, seed: int
    ) -> Problem:
        poses, noise = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
        q = poses.uniform(centre - half, centre + half, (pairs, self.joints))
        x = arm.positions(q) + self.sigma * noise.normal(size=(pairs, 3))
        return Problem(
            q=q,
            x=x,
            low=-reach,
            high=reach,
            rng=np.random.default_rng([seed, 3]),
            sigma=self.sigma,
            drawing=built.drawing if self.drawn else None,
            tolerances=self.tolerances if self.drawn else None,
            measure=_readings(arm, self.sigma, np.random.default_rng([seed, 4])) if self.zone is None else None,
        )


def _with_tool(built: RoughArm, arm: Arm, move: FloatArray) -> tuple[RoughArm, Arm]:
    change = built.change.copy()
    change[built.parameters.tool] += move
    fixed = arm.fixed.copy()
    fixed[-1, :3, 3] += fixed[-1, :3, :3] @ move
    return RoughArm(built.parameters, change), replace(arm, fixed=fixed)


def _readings(arm: Arm, sigma: float, rng: np.random.Generator) -> Measure:
    def measure(q: FloatArray, shift: FloatArray) -> FloatArray:
        return arm.positions(q, shift) + sigma * rng.normal(size=(len(q), 3))

    return measure


def _bent(effect: Effect) -> Setting:
    return Setting(sigma=0.005, reach=60.0, tolerances=MILD, effect=effect)


BENT: dict[str, tuple[str, Setting]] = {
    "rigid": ("rigid, for comparison", _bent(lambda _joints, _rng: None)),
    "sag1": ("gravity sag up to 1°", _bent(lambda joints, _: Sag.on(joints, math.radians(1.0)))),
    "sag3": ("gravity sag up to 3°", _bent(lambda joints, _: Sag.on(joints, math.radians(3.0)))),
    "eccentric": (
        "eccentric encoders, 1°",
        _bent(lambda joints, rng: Eccentric(math.radians(1.0), rng.uniform(-np.pi, np.pi, joints))),
    ),
    "gain": (
        "gear gains off by 1 %",
        _bent(lambda joints, rng: GearGain(1.0 + 0.01 * rng.choice([-1.0, 1.0], joints))),
    ),
    "affine": ("camera affine, 2–3 %", _bent(lambda _, rng: Affine.drawn(rng))),
    "radial": ("camera radial, 2 %", _bent(lambda _joints, _rng: Radial(0.02, 0.5, np.array([0.0, -0.2, -0.3])))),
}


def simulated_tasks() -> list[Task]:
    """Return all tasks that need no recording."""
    tasks = [
        Task(
            f"nothing{d}",
            f"From nothing, {d} joints",
            Setting(joints=d, drawn=False),
            goals={30: 0.01, 300: 0.003} if d == 6 else {},
            note="±80°, σ 10 mm",
        )
        for d in range(4, 9)
    ]
    tasks += [
        Task(
            f"rough{d}",
            f"From a rough nominal model, {d} joints",
            Setting(joints=d),
            goals={30: 0.01, 300: 0.003} if d == 6 else {},
            note="axes 3°, points 15 mm, tip 30 mm a component; ±80°, σ 10 mm",
        )
        for d in (4, 5, 6, 7, 8, 10, 15, 20, 30)
    ]
    tasks += [
        Task(
            "tool",
            "Tool change of 250 mm, known",
            Setting(sigma=0.005, tool_move=0.25),
            counts=(3, 10, 30, 100, 300),
            goals={10: 0.003},
            note="6 joints, rough drawing, 600 pairs before; ±80°, σ 5 mm; n counts the pairs since",
        ),
        Task(
            "local",
            "Local zone of ±20°",
            Setting(zone=20.0),
            goals={300: 0.015},
            note="6 joints, rough drawing, zone about a random centre; asked there and, extrapolated, to ±80°; σ 10 mm",
        ),
    ]
    tasks += [
        Task(key, f"Not rigid: {title}", setting, note="6 joints, drawing off by 2°, 10 mm, 30 mm; ±60°, σ 5 mm")
        for key, (title, setting) in BENT.items()
    ]
    return tasks
