"""Joint source, stereo camera and clock of the simulated world, with the interfaces of real hardware."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Protocol, Self

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray, JointReading, StereoFrame
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend.config import EncoderConfig


class World(Protocol):
    """Interface of the world that the sources read from."""

    robot: RobotDescription

    def open_joints(self, is_open: bool) -> None: ...
    def open_camera(self, is_open: bool) -> None: ...
    def next_reading(self, timeout_s: float) -> JointReading | None: ...
    def next_frame(self, timeout_s: float) -> StereoFrame | None: ...


class SimClock:
    """Simulated time. The wall-clock time is that of opening the world plus simulated time."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._opened = datetime.min

    def start(self, clock: Clock) -> None:
        """Set the wall-clock time at which the world was opened, from `clock`."""
        self._opened = datetime.fromisoformat(clock.utc())

    def now(self) -> float:
        """Return the simulated time [s]."""
        return self._now()

    def utc(self) -> str:
        """Return the wall-clock time of opening the world plus simulated time, ISO 8601 in UTC."""
        return (self._opened + timedelta(seconds=self._now())).isoformat(timespec="milliseconds")


class SimJoints:
    """The encoders of the simulated robot (a `JointSource`)."""

    def __init__(self, world: World) -> None:
        self._world, self.joints = world, world.robot.joints

    def __enter__(self) -> Self:
        self._world.open_joints(True)
        return self

    def __exit__(self, *_: object) -> None:
        self._world.open_joints(False)

    def read(self, timeout_s: float) -> JointReading | None:
        """Return the next reading; None if the world waits longer for the camera to be read.

        Raises:
            SourceEnded: the world was closed.
        """
        return self._world.next_reading(timeout_s)


class SimStereoCamera:
    """The eyes of the simulated robot, a `StereoCamera`; their lenses may differ from its calibration by effects."""

    def __init__(self, world: World, calibration: StereoCalibration) -> None:
        self._world, self.calibration = world, calibration

    def __enter__(self) -> Self:
        self._world.open_camera(True)
        return self

    def __exit__(self, *_: object) -> None:
        self._world.open_camera(False)

    def read(self, timeout_s: float) -> StereoFrame | None:
        """Return the next frame; None if none arrived within `timeout_s`.

        Raises:
            SourceEnded: the world was closed.
            SourceLost: the renderer's process died.
        """
        return self._world.next_frame(timeout_s)


class Encoders:
    """Encoder model that adds offset and noise to angles and rounds them to whole ticks.

    Args:
        offsets: reported minus true angle [rad or m], shape (d,).
        prismatic: True for each prismatic joint, shape (d,).
    """

    def __init__(
        self, config: EncoderConfig, offsets: FloatArray, prismatic: np.ndarray, rng: np.random.Generator
    ) -> None:
        self._tick = np.where(prismatic, 1.0 / config.ticks_per_metre, 2 * np.pi / config.ticks_per_turn)
        self._noise, self._offsets, self._rng = config.noise_ticks, offsets, rng

    def read(self, true: FloatArray) -> FloatArray:
        """Return the readings (d,) [rad or m] at the true angles, or drive positions, `true` (d,)."""
        exact = (true + self._offsets) / self._tick
        noisy = exact + self._noise * self._rng.standard_normal(exact.shape)
        return np.round(noisy) * self._tick
