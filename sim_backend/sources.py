"""What the simulated world looks like to the sampler: a joint source, a stereo camera and a clock, as hardware has."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from types import TracebackType
from typing import Protocol, Self

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import JointReading, StereoFrame
from bodyschema.interfaces.robot import RobotDescription


class World(Protocol):
    """What the sources need of the world."""

    robot: RobotDescription

    def open_joints(self, is_open: bool) -> None: ...
    def open_camera(self, is_open: bool) -> None: ...
    def next_reading(self, timeout_s: float) -> JointReading | None: ...
    def next_frame(self, timeout_s: float) -> StereoFrame | None: ...


class SimClock:
    """Simulated time. Its wall clock shows when the world was opened, plus simulated time."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._opened = datetime.min

    def start(self, clock: Clock) -> None:
        """The world is open: take the wall clock's time."""
        self._opened = datetime.fromisoformat(clock.utc())

    def now(self) -> float:
        """Simulated time [s]."""
        return self._now()

    def utc(self) -> str:
        """Wall-clock time at which the world was opened plus simulated time, ISO 8601 in UTC."""
        return (self._opened + timedelta(seconds=self._now())).isoformat(timespec="milliseconds")


class SimJoints:
    """The encoders of the simulated robot (a `JointSource`)."""

    def __init__(self, world: World) -> None:
        self._world = world

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in the order of q."""
        return self._world.robot.joints

    def __enter__(self) -> Self:
        self._world.open_joints(True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._world.open_joints(False)

    def read(self, timeout_s: float) -> JointReading | None:
        """The next reading; None when the world waits for the camera to be read longer than `timeout_s`.

        Raises:
            SourceEnded: the world was closed.
        """
        return self._world.next_reading(timeout_s)


class SimStereoCamera:
    """The eyes of the simulated robot (a `StereoCamera`)."""

    def __init__(self, world: World, calibration: StereoCalibration) -> None:
        self._world, self._calibration = world, calibration

    @property
    def calibration(self) -> StereoCalibration:
        """The described calibration; the simulated lenses agree with it, but for the effects that they are given."""
        return self._calibration

    def __enter__(self) -> Self:
        self._world.open_camera(True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._world.open_camera(False)

    def read(self, timeout_s: float) -> StereoFrame | None:
        """The next frame; None when none came within `timeout_s`.

        Raises:
            SourceEnded: the world was closed.
            SourceLost: the renderer's process died.
        """
        return self._world.next_frame(timeout_s)
