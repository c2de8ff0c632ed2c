"""Simulate the mechanics of the world step by step: hand, arm and head."""

from __future__ import annotations

from collections import deque
from contextlib import ExitStack
from math import ceil, lcm
from typing import Self

import numpy as np

from bodyschema.effects import Identity, LiveEncoders, Motion
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from bodyschema.sim_backend.bullet import Body
from bodyschema.sim_backend.config import SimConfig
from bodyschema.sim_backend.hand import GuidePath, VirtualHand
from bodyschema.sim_backend.physics_urdf import physics_urdf
from bodyschema.sim_backend.randomness import Stream, generator
from bodyschema.sim_backend.rendering.scene import Scene, scene_of
from bodyschema.sim_backend.sources import Encoders
from bodyschema.sim_backend.truth import JointRoles, TrueRobot
from bodyschema.sim_backend.visibility import Gaze, Sight


class JointPaths:
    """Joint angles over time, for each step of the physics.

    With a positive camera latency, a frame shows the joints as they were earlier. With a negative one, the readings are
    those of an earlier time. Effects that depend on the last move use the move during the last frame interval. This is
    the move between successive pairs as long as every frame becomes a pair.

    Args:
        rate_hz: steps a second, a multiple of the frames.
        camera_hz: frames a second.
        begins: start time of drift, that of the first frame [s].
    """

    def __init__(self, truth: TrueRobot, rate_hz: int, camera_hz: int, *, begins: float) -> None:
        self._truth, self._begins = truth, begins
        latency = truth.beyond.latency_s
        self._frame_delay_steps, self._reading_delay_steps = max(latency, 0.0) * rate_hz, max(-latency, 0.0) * rate_hz
        self._frame_steps = rate_hz // camera_hz
        self._live = LiveEncoders(truth.beyond, self._frame_steps)
        longest = max(self._frame_delay_steps + self._frame_steps, self._reading_delay_steps)
        self._history: deque[FloatArray] = deque(maxlen=ceil(longest) + 3)
        self._t = 0.0
        self._unloaded = np.zeros(0)
        self._flanks: dict[Identity, float] = {}

    @property
    def plain(self) -> bool:
        """True if the joints are at the drive positions: no effect moves them."""
        return not any(effect.kind.moves_joints for effect in self._truth.beyond.all_effects)

    def record(self, angles: FloatArray, t: float) -> None:
        """Record the drive positions `angles` (d,) [rad or m] at the time t [s], one step after the last record."""
        self._history.append(angles)
        self._t = t
        if not self.plain:
            q = self._angles_before(self._frame_delay_steps)
            move = q - self._angles_before(self._frame_delay_steps + self._frame_steps)
            offsets = self._truth.offsets
            self._unloaded = self._live.true_angles(q + offsets, t, move) - offsets

    @property
    def read(self) -> FloatArray:
        """Drive positions (d,) [rad or m] that the encoders sample now, without the joint offsets."""
        return self._angles_before(self._reading_delay_steps)

    @property
    def seen(self) -> FloatArray:
        """True joint angles (d,) [rad or m] in a frame taken now."""
        if self.plain:
            return self._history[-1]
        return self._unloaded + self._truth.beyond.deflections(self._unloaded[None], self._flanks)[0]

    @property
    def row(self) -> Motion:
        """Exact encoder readings at the time of a frame taken now, one row."""
        return Motion.at(self.read + self._truth.offsets, self._t, self._begins)

    def _angles_before(self, steps: float) -> FloatArray:
        """Return the drive positions `steps` steps ago, by a parabola through three steps; at first, the oldest."""
        if steps == 0.0:
            return self._history[-1]
        middle = min(max(round(steps), 1), len(self._history) - 2)
        if middle < 1 or steps > len(self._history) - 1:
            return self._history[0]
        after, at, before = (self._history[-1 - k] for k in (middle - 1, middle, middle + 1))
        s = steps - middle
        return at + 0.5 * s * (before - after) + 0.5 * s * s * (before - 2.0 * at + after)


class _Settings:
    servo_gain: float = 0.3  # of the head's position control
    servo_force: float = 200.0  # largest torque of the head's joints [N·m]
    slowest_physics_hz: int = 240  # pybullet's default


class TorqueFreeArm:
    """A body's joints, of which the guided ones get gravity compensation at most.

    Args:
        friction: viscous friction of each joint [N·m·s or N·s/m], shape (d,).
        gravity_compensation: bear the arm's weight.
    """

    def __init__(self, body: Body, roles: JointRoles, friction: FloatArray, *, gravity_compensation: bool) -> None:
        self._body = body
        self._guided = list(roles.guided)
        self._gaze = list(roles.gaze)
        self._compensate = gravity_compensation
        for joint, damping in zip(body.joints, friction, strict=True):
            body.bullet.changeDynamics(
                body.id, joint, jointDamping=damping, linearDamping=0, angularDamping=0, physicsClientId=body.client
            )
        for k in self._guided:  # pybullet gives every joint a braking motor
            body.bullet.setJointMotorControl2(
                body.id, body.joints[k], body.bullet.VELOCITY_CONTROL, force=0.0, physicsClientId=body.client
            )

    def step(self, gaze_target: FloatArray) -> None:
        """Take one step of physics with the gazing joints' servos at the true angles `gaze_target` (g,) [rad]."""
        body = self._body
        if self._compensate:
            torques = body.gravity_torques(body.angles())
            body.bullet.setJointMotorControlArray(
                body.id,
                [body.joints[k] for k in self._guided],
                body.bullet.TORQUE_CONTROL,
                forces=torques[self._guided].tolist(),
                physicsClientId=body.client,
            )
        if self._gaze:
            body.bullet.setJointMotorControlArray(
                body.id,
                [body.joints[k] for k in self._gaze],
                body.bullet.POSITION_CONTROL,
                targetPositions=gaze_target.tolist(),
                positionGains=[_Settings.servo_gain] * len(self._gaze),
                forces=[_Settings.servo_force] * len(self._gaze),
                physicsClientId=body.client,
            )
        body.bullet.stepSimulation(physicsClientId=body.client)


class Physics:
    """The guided robot. Time is counted in steps, independent of the readers."""

    def __init__(self, truth: TrueRobot, calibration: StereoCalibration, config: SimConfig) -> None:
        self._truth, self._calibration, self._config = truth, calibration, config
        common = lcm(config.encoders.rate_hz, config.camera.rate_hz)
        self.rate_hz = common * max(1, -(-_Settings.slowest_physics_hz // common))
        self.steps = 0
        self.urdf = physics_urdf(truth)
        self.marker_xyz = np.array(truth.robot.robot.marker_xyz)
        rng = generator(config.seed, Stream.ENCODERS)
        self._encoders = Encoders(config.encoders, truth.offsets, truth.robot.chain.prismatic, rng)
        self._paths = JointPaths(truth, self.rate_hz, config.camera.rate_hz, begins=1.0 / config.camera.rate_hz)
        self._exit = ExitStack()

    def __enter__(self) -> Self:
        robot, config = self._truth.robot, self._config
        with ExitStack() as stack:
            self.body = stack.enter_context(Body(self.urdf, robot.joints, dt=1 / self.rate_hz))
            watched = stack.enter_context(Body(self.urdf, robot.joints))
            # The cameras see the joints at their true angles.
            self._seen = self.body if self._paths.plain else stack.enter_context(Body(self.urdf, robot.joints))
            roles = JointRoles.of(robot)
            self._gazing = list(roles.gaze)
            self._gaze = Gaze(robot, self._calibration, roles.gaze)
            self.sight = Sight(self._truth, self._calibration, roles, self._gaze, watched, config.camera)
            self._path = GuidePath(
                self.sight,
                robot.lower,
                robot.upper,
                roles.guided,
                config.guide.speed_rad_s / self.rate_hz,
                generator(config.seed, Stream.WAYPOINTS),
            )
            self._hand = VirtualHand(self.body, self._truth, roles, config.guide, self._path.waypoints)
            start = self._path.waypoints[0]
            self.body.set_angles(start - self._truth.offsets)
            self._paths.record(self.body.angles(), 0.0)
            self._command = start[self._gazing]
            self._plan(start)
            self._arm = TorqueFreeArm(
                self.body, roles, self._hand.friction, gravity_compensation=config.guide.gravity_compensation
            )
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    def step(self) -> None:
        """Advance by one time step."""
        if self._next_posture == len(self._postures):
            self._plan(self._postures[-1])
        self._hand.pull(self._goals, self._next_posture)
        self._next_posture += 1
        self._arm.step(self._command - self._truth.offsets[self._gazing])
        self.steps += 1
        self._paths.record(self.body.angles(), self.steps / self.rate_hz)

    def read_encoders(self) -> FloatArray:
        """Return a reading (d,) of all encoders, and update the gaze command from it."""
        q = self._encoders.read(self._paths.read)
        self._command = self._gaze.track(q, self._command, 1 / self._config.encoders.rate_hz)
        return q

    def scene(self) -> Scene:
        """Return the scene of a frame taken now."""
        if not self._paths.plain:
            self._seen.set_angles(self._paths.seen)
        return scene_of(self._seen, self._truth, self.marker_xyz, self._calibration, self._paths.row)

    def change_tool(self, marker_xyz: FloatArray) -> None:
        """Put a tool into the hand whose marker is at `marker_xyz` (3,) [m] in the marker link."""
        self.marker_xyz = marker_xyz
        self._gaze.hold_tool(marker_xyz)
        self.sight.hold_tool(marker_xyz)
        here = self._postures[self._next_posture - 1]
        self._path.replan(here)
        self._plan(here)

    def _plan(self, posture: FloatArray) -> None:
        """Plan the next hop from `posture` (d,), the current position on the path."""
        hop = self._path.hop()
        while not len(hop):
            hop = self._path.hop()
        self._postures = np.vstack([posture, hop])
        self._goals = self._hand.goals(self._postures)
        self._next_posture = 1
