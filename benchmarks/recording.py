"""Recordings of real robots: folders with a robot.toml and a measured.csv."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodyschema.robot.description import RobotDescription
from kbmaps import ChainTolerances, RigidChain
from kbmaps.arrays import FloatArray, IntArray

# Tolerances of a robot about its maker's nominal model; instrument and reflector poses are unknown.
RECORDED = ChainTolerances(
    axes=math.radians(1.0),
    points=0.005,
    zeros=math.radians(1.0),
    tool=math.inf,
    base_rotation=math.inf,
    base_translation=math.inf,
)


@dataclass(frozen=True, eq=False)
class Recording:
    """A measured robot.

    Attributes:
        chain: the manufacturer's nominal chain.
        q, x: measured readings (n, d) [rad] and positions (n, 3) [m].
    """

    chain: RigidChain
    q: FloatArray
    x: FloatArray

    def __len__(self) -> int:
        return len(self.q)

    @classmethod
    def load(cls, folder: Path) -> Recording:
        robot = RobotDescription.load(folder / "robot.toml")
        table = np.genfromtxt(folder / "measured.csv", delimiter=",", skip_header=1)
        return cls(robot.chain, table[:, : robot.chain.joints], table[:, -3:])

    def split(self, pairs: int, seed: int) -> tuple[IntArray, IntArray]:
        """Split rows at random into `pairs` training rows and all others."""
        order = np.random.default_rng(seed).permutation(len(self))
        return order[:pairs], order[pairs:]
