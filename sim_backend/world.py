"""Run physics, encoders and cameras in lock step on one simulated clock."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Self

import msgspec
import numpy as np

from bodyschema.effects import Simulation
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, SourceEnded, SourceError
from bodyschema.interfaces.records import FloatArray, ImageArray, JointReading, StereoFrame, frozen_array
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend.config import EncoderConfig, SimConfig
from bodyschema.sim_backend.physics import Physics
from bodyschema.sim_backend.rendering.render_client import RenderProcess
from bodyschema.sim_backend.truth import TrueRobot
from kbmaps import RigidChain

from .sources import SimClock, SimJoints, SimStereoCamera

log = logging.getLogger(__name__)


class _Settings:
    # Limits on running ahead of the readers: frames taken but not read, and seconds of joint readings.
    frames_ahead: int = 2
    readings_ahead_s: float = 1.0


@dataclass(slots=True)
class WorldStats:
    """Counts since the world was opened."""

    readings: int = 0
    frames: int = 0
    tool_changes: int = 0


class SimWorld:
    """Simulated robot guided by hand, with its encoders and stereo cameras.

    Every read advances the world; nothing happens between reads. Simulated time therefore passes as fast as the
    readers read. The world never runs more than two frames, or a second of joint readings, ahead of an open source,
    so two threads may read joints and camera each at its own pace. The same description and configuration reproduce
    readings and frames bit by bit. Open both sources before the first read.

    Args:
        robot: the described robot; it needs a stereo calibration.
        extension: the robot with effects, to which the random errors are added; None for no effects.

    Raises:
        ConfigError: [camera] has no stereo calibration, or pybullet is not installed (both on entering).
    """

    def __init__(self, robot: RobotDescription, config: SimConfig, extension: Simulation | None = None) -> None:
        self.robot, self.config, self._extension = robot, config, extension
        self.clock = SimClock(self.now)
        self.stats = WorldStats()
        self._moved = threading.Condition()
        self._fetching = threading.Lock()
        self._exit = ExitStack()
        self._readings: deque[JointReading] = deque()
        self._frame_times: deque[float] = deque()
        self._planned = deque(sorted(config.tool_changes, key=lambda change: change.at_s))
        self._requested_tool: FloatArray | None = None
        self._joints_open = self._camera_open = self._running = False
        self._frames_taken = self._delivered = 0

    def __enter__(self) -> Self:
        calibration = stereo_calibration(self.robot)
        self._truth = TrueRobot.draw(self.robot, self.config, self._extension)
        with ExitStack() as stack:
            self._physics = stack.enter_context(Physics(self._truth, calibration, self.config))
            for sentence in self._physics.urdf.said:
                log.warning("%s", sentence)
            self._renderer = stack.enter_context(
                RenderProcess(self._physics.urdf, self._truth, calibration, self.config)
            )
            self.joints = SimJoints(self)
            self.camera = SimStereoCamera(self, calibration)
            self._exit = stack.pop_all()
        self.clock.start(SystemClock())
        self._running = True
        return self

    def __exit__(self, *_: object) -> None:
        with self._moved:
            self._running = False
            self._moved.notify_all()
        with self._fetching:  # a reader may still wait for the renderer
            self._exit.close()

    def now(self) -> float:
        """Return the simulated time of the last step [s]; a frame may be up to two frame intervals older."""
        return self._physics.steps / self._physics.rate_hz

    def change_tool(self, marker_xyz: tuple[float, float, float] | FloatArray) -> float:
        """Put another tool into the hand, with its described marker at `marker_xyz` [m] in the marker link.

        May be called from any thread. The guide chooses new postures for it and the gaze follows it at once.

        Returns:
            Simulated time [s]: all frames after it show the new tool.
        """
        with self._moved:
            self._requested_tool = np.array(marker_xyz, dtype=np.float64)
            return self.now()

    def true_chain(self) -> RigidChain:
        """Return the ground-truth chain from the left eye to the marker, over reported angles.

        It includes only those effects of `extension` that a rigid chain can represent.
        """
        with self._moved:
            wanted = self._physics.marker_xyz if self._requested_tool is None else self._requested_tool
            return self._truth.chain(wanted)

    def true_turn(self) -> FloatArray:
        """Return the ground-truth rotation (3, 3) of the marker on the hand."""
        return self._truth.tool_turn

    def open_joints(self, is_open: bool) -> None:
        """Start or stop keeping readings for the joint source."""
        with self._moved:
            self._joints_open = is_open
            self._readings.clear()
            self._moved.notify_all()

    def open_camera(self, is_open: bool) -> None:
        """Start or stop taking frames for the camera; replace the renderer first if it has died."""
        with self._fetching, self._moved:
            if is_open and self._renderer.process.poll() is not None:  # the frames in progress are lost
                self._renderer.__exit__(None, None, None)
                self._renderer.__enter__()
                self._delivered = self._frames_taken
                self._frame_times.clear()
            self._camera_open = is_open
            self._moved.notify_all()

    def next_reading(self, timeout_s: float) -> JointReading | None:
        """Return the next reading; None if none arrived within `timeout_s` because the camera must be read first."""
        end = time.monotonic() + timeout_s
        with self._moved:
            while True:
                self._check_open(self._joints_open)
                if self._readings:
                    self._moved.notify_all()
                    return self._readings.popleft()
                if self._may_take_frame():
                    self._step()
                elif not self._moved.wait(end - time.monotonic()):
                    return None

    def next_frame(self, timeout_s: float) -> StereoFrame | None:
        """Return the next frame; None if none arrived within `timeout_s`."""
        end = time.monotonic() + timeout_s
        with self._fetching:
            if not self._take_frames(end):
                return None
            images = self._renderer.fetch(self._delivered, end - time.monotonic())
            if images is None:
                return None
            with self._moved:
                self._delivered += 1
                t = self._frame_times.popleft()
                self._moved.notify_all()
            return stereo_frame(t, images)

    def _take_frames(self, end: float) -> bool:
        """Advance until the renderer has frames to render ahead; return False if it did not within the time."""
        with self._moved:
            while self._may_take_frame():
                self._check_open(self._camera_open)
                if len(self._readings) < _Settings.readings_ahead_s * self.config.encoders.rate_hz:
                    self._step()
                elif self._frame_times:
                    break
                elif not self._moved.wait(end - time.monotonic()):
                    return False
            self._check_open(self._camera_open)
            return True

    def _may_take_frame(self) -> bool:
        return not self._camera_open or self._frames_taken - self._delivered < _Settings.frames_ahead

    def _check_open(self, is_open: bool) -> None:
        if not self._running:
            raise SourceEnded("the simulated world has been closed")
        if not is_open:
            raise SourceError("the simulated source is not open; use it in a with statement")

    def _step(self) -> None:
        """Advance by one time step, then take the reading and the frame due at its end, in this order."""
        physics = self._physics
        physics.step()
        self._change_tool_when_due()
        t = self.now()
        if physics.steps % (physics.rate_hz // self.config.encoders.rate_hz) == 0:
            q = physics.read_encoders()
            if self._joints_open:
                self._readings.append(JointReading(t, frozen_array(q)))
                self.stats.readings += 1
        if self._camera_open and physics.steps % (physics.rate_hz // self.config.camera.rate_hz) == 0:
            self._renderer.request(self._frames_taken, physics.scene())
            self._frame_times.append(t)
            self._frames_taken += 1
            self.stats.frames += 1

    def _change_tool_when_due(self) -> None:
        while self._planned and self._planned[0].at_s <= self.now():
            self._requested_tool = np.array(self._planned.popleft().marker_xyz)
        if self._requested_tool is None:
            return
        self._physics.change_tool(self._requested_tool)
        self._requested_tool = None
        self.stats.tool_changes += 1


def true_chain(
    robot: RobotDescription,
    config: SimConfig,
    marker_xyz: tuple[float, float, float] | FloatArray | None = None,
    *,
    extension: Simulation | None = None,
) -> RigidChain:
    """Return the ground-truth chain of the world that `robot` and `config` would open; needs no pybullet.

    Args:
        marker_xyz: the described marker of the tool in the hand [m]; None for that of robot.toml.
    """
    described = robot.robot.marker_xyz if marker_xyz is None else marker_xyz
    return TrueRobot.draw(robot, config, extension).chain(np.array(described, dtype=np.float64))


def stereo_calibration(robot: RobotDescription) -> StereoCalibration:
    """Return the calibration of the stereo pair, or single camera, in [camera]; raise ConfigError if there is none."""
    if robot.calibration is None:
        raise ConfigError(
            "the simulation renders images, but [camera] does not describe how the cameras see",
            file=robot.file,
            remedy="Add focal_px, principal_point_px, image_size_px, and baseline_m or eyes = 1 to [camera]. In a "
            "robot.toml of `bodyschema init` these lines stand behind #",
        )
    return robot.calibration


def stereo_frame(t: float, images: tuple[ImageArray, ...]) -> StereoFrame:
    """Build a frame from each eye's image (height, width, 3), BGR, the left one first; they become read-only."""
    for image in images:
        image.setflags(write=False)
    return StereoFrame(t, images[0], images[1] if len(images) > 1 else None)


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
