"""Simulate a robot at rest: move it to each of a list of postures, read the encoders and render a frame there."""

from __future__ import annotations

import logging
import threading
from contextlib import ExitStack
from typing import Self

import numpy as np

from bodyschema.effects import Motion, Simulation
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, SourceEnded
from bodyschema.interfaces.records import FloatArray, JointReading, StereoFrame, frozen_array
from bodyschema.robot.description import RobotDescription
from bodyschema.sim_backend.bullet import Body
from bodyschema.sim_backend.config import SimConfig
from bodyschema.sim_backend.physics_urdf import physics_urdf
from bodyschema.sim_backend.randomness import Stream, generator
from bodyschema.sim_backend.rendering.render_client import RenderProcess
from bodyschema.sim_backend.rendering.scene import Scene, scene_of
from bodyschema.sim_backend.truth import JointRoles, TrueRobot
from bodyschema.sim_backend.visibility import Gaze, Sight
from kbmaps import RigidChain

from .sources import Encoders, SimClock, SimJoints, SimStereoCamera
from .world import stereo_calibration, stereo_frame

log = logging.getLogger(__name__)


class _Settings:
    # Number of frames that are rendered ahead.
    ahead: int = 2
    batch: int = 500
    max_batches: int = 400
    # How far the head may be turned away from the marker [rad]: with it the head's angles say more than where the hand
    # is.
    wander: float = np.radians(20.0)
    period_s: float = 1.0  # time from one posture to the next [s]


class PosedWorld:
    """A robot that stands still in given postures when its encoders are read and its frames are taken.

    Each posture gives one reading and one frame with the same time. The same arguments reproduce them bit by bit.

    Args:
        robot: the described robot; it needs a stereo calibration.
        postures: reported joint angles (n, d) [rad or m] to go to; encoders report them in whole ticks.
        extension: the robot with effects, to which the random errors are added; None for no effects. Camera latency has
            no influence on a robot that stands still.

    Raises:
        ConfigError: [camera] has no stereo calibration, or pybullet is not installed (both on entering).
    """

    def __init__(
        self, robot: RobotDescription, config: SimConfig, postures: FloatArray, extension: Simulation | None = None
    ) -> None:
        self.robot, self.config, self._extension = robot, config, extension
        self.clock = SimClock(self.now)
        self._postures = frozen_array(postures)
        self._fetching = threading.Lock()
        self._exit = ExitStack()
        self._read = self._requested = self._delivered = 0

    def __enter__(self) -> Self:
        self._calibration = calibration = stereo_calibration(self.robot)
        self._truth = TrueRobot.draw(self.robot, self.config, self._extension)
        self._marker = np.array(self.robot.robot.marker_xyz)
        rng = generator(self.config.seed, Stream.ENCODERS)
        prismatic = self.robot.chain.prismatic
        self._encoders = Encoders(self.config.encoders, self._truth.offsets, prismatic, rng)
        count, beyond = len(self._postures), self._truth.beyond
        motion = Motion(
            self._postures, _Settings.period_s * np.arange(1.0, count + 1.0), np.zeros(count, dtype=np.int64)
        )
        unloaded = beyond.unloaded(motion) - self._truth.offsets
        self._angles = unloaded + beyond.deflections(unloaded)  # true ones (n, d) [rad or m]
        urdf = physics_urdf(self._truth)
        for sentence in urdf.said:
            log.warning("%s", sentence)
        with ExitStack() as stack:
            self._body = stack.enter_context(Body(urdf, self.robot.joints))
            self._renderer = stack.enter_context(RenderProcess(urdf, self._truth, calibration, self.config))
            self._exit = stack.pop_all()
        self.joints = SimJoints(self)
        self.camera = SimStereoCamera(self, calibration)
        self.clock.start(SystemClock())
        return self

    def __exit__(self, *_: object) -> None:
        with self._fetching:
            self._exit.close()

    def now(self) -> float:
        """Return the time of the posture seen last [s]."""
        return self._delivered * _Settings.period_s

    def true_chain(self) -> RigidChain:
        """Return the ground-truth chain from the left eye to the marker, over reported angles."""
        return self._truth.chain(self._marker)

    def open_joints(self, is_open: bool) -> None:
        """Do nothing: readings continue with the first posture that was not read."""

    def open_camera(self, is_open: bool) -> None:
        """Request frames when opened; they continue with the first posture that was not fetched."""
        with self._fetching:
            if is_open:
                self._ask_ahead()

    def next_reading(self, timeout_s: float) -> JointReading:  # noqa: ARG002 - nothing to wait for
        """Return the encoders' reading in the next posture; raise SourceEnded if there are no more."""
        if self._read == len(self._postures):
            raise SourceEnded("the encoders were read in all postures")
        q = self._encoders.read(self._postures[self._read] - self._truth.offsets)
        self._read += 1
        return JointReading(self._read * _Settings.period_s, frozen_array(q))

    def next_frame(self, timeout_s: float) -> StereoFrame | None:
        """Return the next posture's frame; None if it is not rendered in time.

        Raises:
            SourceEnded: there are no more.
        """
        with self._fetching:
            if self._delivered == len(self._postures):
                raise SourceEnded("all postures were seen")
            images = self._renderer.fetch(self._delivered, timeout_s)
            if images is None:
                return None
            self._delivered += 1
            self._ask_ahead()
            return stereo_frame(self.now(), images)

    def _ask_ahead(self) -> None:
        while self._requested < min(self._delivered + _Settings.ahead, len(self._postures)):
            self._renderer.request(self._requested, self.scene(self._requested))
            self._requested += 1

    def scene(self, number: int) -> Scene:
        """Return the scene of the frame of posture `number`."""
        self._body.set_angles(self._angles[number])
        row = Motion.at(self._postures[number], (number + 1) * _Settings.period_s, _Settings.period_s)
        return scene_of(self._body, self._truth, self._marker, self._calibration, row)


def visible_postures(
    robot: RobotDescription, config: SimConfig, count: int, extension: Simulation | None = None
) -> FloatArray:
    """Return postures (count, d) [rad or m], as encoders report them, in which the true cameras see the marker.

    Guided joints are uniform over their ranges; the head is uniform about the direction to the marker.

    Args:
        extension: the robot with effects; those that a chain cannot have are ignored in it.

    Raises:
        ConfigError: the cameras see the marker in too few of the sampled postures.
    """
    calibration, truth = stereo_calibration(robot), TrueRobot.draw(robot, config, extension)
    roles, rng = JointRoles.of(robot), generator(config.seed, Stream.WAYPOINTS)
    guided, gaze = list(roles.guided), list(roles.gaze)
    found: list[FloatArray] = []
    with Body(physics_urdf(truth), robot.joints) as body:
        looking = Gaze(robot, calibration, roles.gaze)
        sight = Sight(truth, calibration, roles, looking, body, config.camera)
        for _ in range(_Settings.max_batches):
            q = np.tile((robot.lower + robot.upper) / 2, (_Settings.batch, 1))
            q[:, guided] = rng.uniform(robot.lower[guided], robot.upper[guided], (_Settings.batch, len(guided)))
            q = sight.gazed(q)
            q[:, gaze] += rng.uniform(-_Settings.wander, _Settings.wander, (_Settings.batch, len(gaze)))
            q = np.clip(q, robot.lower, robot.upper)
            found += list(q[sight.visible(q)])
            if len(found) >= count:
                return np.array(found[:count])
    raise ConfigError(
        f"the cameras see the marker in only {len(found)} of {_Settings.batch * _Settings.max_batches} postures",
        remedy="Check [camera] xyz and rpy, marker_xyz and the joint limits",
    )
