"""Tasks from recordings of real robots: folders with a robot.toml and a measured.csv."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.peers.problem import Problem
from benchmarks.peers.tasks import COUNTS, Task, Trial
from interfaces.robot import RobotDescription
from kbmaps import ChainTolerances, RigidChain, align
from kbmaps.arrays import FloatArray

TOLERANCES = ChainTolerances(
    axes=math.radians(1.0),
    points=0.005,
    zeros=math.radians(1.0),
    tool=math.inf,
    base_rotation=math.inf,
    base_translation=math.inf,
)
_LEAST_HELD_OUT = 30
_MOST_HELD_OUT = 500


@dataclass(frozen=True, eq=False)
class Recording:
    """Random splits of a recording: some pairs to learn, the others held out.

    Where the instrument stood and the reflector sat is fitted to the pairs first, for all competitors alike.
    """

    chain: RigidChain
    q: FloatArray
    x: FloatArray

    @classmethod
    def load(cls, folder: Path) -> Recording:
        robot = RobotDescription.load(folder / "robot.toml")
        table = np.genfromtxt(folder / "measured.csv", delimiter=",", skip_header=1)
        return cls(robot.chain, table[:, : robot.chain.joints], table[:, -3:])

    def __call__(self, seed: int, pairs: int) -> Trial | None:
        if pairs > len(self.q) - _LEAST_HELD_OUT:
            return None
        order = np.random.default_rng(seed).permutation(len(self.q))
        learnt, held = order[:pairs], order[pairs:][-_MOST_HELD_OUT:]
        q, x = self.q[learnt], self.x[learnt]
        aligned = align(self.chain, q, x, pose_known=False, marker_known=False)
        problem = Problem(
            q=q,
            x=x,
            low=self.q.min(axis=0),
            high=self.q.max(axis=0),
            rng=np.random.default_rng([seed, 3]),
            drawing=aligned.chain,
            tolerances=TOLERANCES,
        )
        return Trial(problem, {"held out": (self.q[held], self.x[held])})


def recorded_tasks(data: Path | None) -> list[Task]:
    """One task a recording below `data`; none without."""
    folders = [] if data is None else sorted(path.parent for path in data.glob("*/robot.toml"))
    return [
        Task(
            folder.name,
            f"Recording {folder.name}",
            Recording.load(folder),
            counts=COUNTS,
            goals={30: 0.00012} if folder.name == "ur5_laser" else {},
            note="a real robot; error of held-out readings, their own noise included; aligned to the pairs first",
        )
        for folder in folders
    ]
