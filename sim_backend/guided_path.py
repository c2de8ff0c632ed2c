"""Joint angles along which the virtual hand guides the arm, without cameras."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from bodyschema.effects import Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

from .config import EncoderConfig, SimConfig
from .physics import Physics
from .truth import TrueRobot
from .world import stereo_calibration

# Finer than any encoder: the user of the angles adds the resolution of the real encoders.
FINEST = 2**30


def exact_encoders(config: SimConfig) -> SimConfig:
    """Return the configuration with encoders that have no noise and a negligible quantisation."""
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
    """Return noise-free encoder readings (n, d) [rad or m], `config.encoders.rate_hz` rows a second.

    Args:
        tell: called with the simulated seconds done so far.

    Raises:
        ConfigError: [camera] describes no stereo pair (the hand keeps the marker in its view), or pybullet is not
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
