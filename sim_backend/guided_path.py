"""Joint angles along which the virtual hand guides the arm, without cameras."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from bodyschema.effects import Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.robot import RobotDescription

from .config import EncoderConfig, SimConfig
from .physics import Physics
from .truth import TrueRobot
from .world import stereo_calibration

# Finer than any encoder: whoever is told the angles adds the resolution of his own.
FINEST = 2**30


def exact_encoders(config: SimConfig) -> SimConfig:
    """The same with encoders that have neither noise nor a resolution to speak of."""
    rate_hz = config.encoders.rate_hz
    exact = EncoderConfig(ticks_per_turn=FINEST, ticks_per_metre=FINEST, noise_ticks=0.0, rate_hz=rate_hz)
    return msgspec.structs.replace(config, encoders=exact)


def guided_path(
    robot: RobotDescription,
    config: SimConfig,
    duration_s: float,
    extension: Simulation | None = None,
    tell: Callable[[float], None] = lambda _: None,
) -> FloatArray:
    """What encoders without noise would read, shape (n, d) [rad or m], `config.encoders.rate_hz` rows a second.

    Args:
        tell: called with the seconds that are done.

    Raises:
        ConfigError: [camera] describes no stereo pair, whose sight the hand keeps the marker in; or pybullet is not
            installed.
    """
    calibration = stereo_calibration(robot)
    config = exact_encoders(config)
    rate_hz = config.encoders.rate_hz
    rows = []
    with Physics(TrueRobot.draw(robot, config, extension), calibration, config) as physics:
        between = physics.rate_hz // rate_hz
        for row in range(round(duration_s * rate_hz)):
            for _ in range(between):
                physics.step()
            rows.append(physics.read_encoders())
            if row % rate_hz == 0:
                tell(row / rate_hz)
    return np.array(rows)
