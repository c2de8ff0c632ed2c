"""Measured data: the simulated robot, guided or put into postures, rendered, tracked and sampled."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodyschema.cli.terminal.screen import Say
from bodyschema.daemon.config import DaemonConfig
from bodyschema.daemon.wiring.wiring import open_postures, open_sources, simulated_truth
from bodyschema.interfaces.records import FloatArray
from kbmaps import RigidChain

from .arm import JOINTS
from .arm import configuration as configured
from .sampling import sampled

# The tracker may miss the ball in some of the postures.
_SPARE = 1.05


@dataclass(frozen=True)
class Measured:
    """The sampler's pairs from rendered images and encoder ticks.

    Attributes:
        q: readings (n, d) [rad].
        x: tracked positions (n, 3) [m].
        true: true chain from left eye to marker, over the readings.
        nominal: the same by the robot's description.
    """

    q: FloatArray
    x: FloatArray
    true: RigidChain
    nominal: RigidChain

    @property
    def noise_m(self) -> float:
        """Mean distance between tracked and true positions [m]."""
        return float(np.linalg.norm(self.x - self.true.positions(self.q), axis=1).mean())


def guided_walk(joints: int, count: int, seed: int, say: Say) -> Measured:
    """Return a walk by the virtual hand, in the sampler's steps of 1° to 3°."""
    with tempfile.TemporaryDirectory(prefix="bodyschema_") as folder:
        config = configured(JOINTS[joints], Path(folder), DaemonConfig(), sim_seed=seed)
        with open_sources(config, sim=True) as sources:
            q, x = sampled(config, sources, count, say)
        return Measured(q, x, simulated_truth(config), config.robot.chain)


def postures(joints: int, count: int, seed: int, say: Say) -> Measured:
    """Return independently sampled postures, without a path between them: the sampler's step rule is off."""
    with tempfile.TemporaryDirectory(prefix="bodyschema_") as folder:
        config = configured(JOINTS[joints], Path(folder), DaemonConfig(any_step=True), sim_seed=seed)
        with open_postures(config, int(_SPARE * count)) as sources:
            q, x = sampled(config, sources, count, say)
        return Measured(q, x, simulated_truth(config), config.robot.chain)
