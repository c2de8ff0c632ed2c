"""The simulation as a pipeline: encoder, structure, tool, camera, time; the nominal one with effects added.

x_measured = drift(t) + residual(q(t)) + optics(camera(tool(structure(encoder(q(t - latency))))))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.robot import RobotDescription
from bodyschema.interfaces.urdf import inverse
from kbmaps import RigidChain

from .effect import Effect
from .encoder import Place
from .gravity import GravityLoad
from .moments import after, settled
from .motion import Motion
from .optics import Optics
from .poses import transforms
from .simulated import Simulated

# A spring's deflection changes its own load: each round brings the next order.
_SPRING_ROUNDS = 3
# Effects that a rigid chain can have in it.
RIGID = ("joint_offset", "link_geometry", "tool_offset", "camera_pose")
# What an effect with a moment is after it; what is not there when nothing moves.
_STAYS = {"encoder_jump": "joint_offset", "tool_slip": "tool_offset", "camera_moved": "camera_pose"}
_OF_MOTION = ("backlash", "settling", "camera_latency", "thermal_drift")


class Residual(Protocol):
    """What no effect explains, as a smooth function of the readings."""

    def predict(self, q: FloatArray) -> FloatArray:
        """How far (n, 3) [m] what is measured is from what the effects give, at the readings q (n, d) [rad, m]."""
        ...


@dataclass(frozen=True, eq=False)
class Simulation:
    """A robot with effects: what its cameras would report.

    Attributes:
        robot: the robot as described.
        effects: what is added to it.
        residual: what is added to what is measured; None for nothing. It depends on the readings alone, so no effect
            changes it.
        background: small errors everywhere, within what the arm's makers tolerate: none of them is a finding.
    """

    robot: RobotDescription
    effects: tuple[Effect, ...] = ()
    residual: Residual | None = None
    background: tuple[Effect, ...] = ()

    @cached_property
    def all_effects(self) -> tuple[Effect, ...]:
        """The background, then the effects."""
        return (*self.background, *self.effects)

    @cached_property
    def gravity(self) -> GravityLoad:
        """Gravity's torques about the joints."""
        return GravityLoad(self.robot)

    def with_effects(self, effects: Sequence[Effect]) -> Simulation:
        """The same robot and residual with these effects in the place of its own."""
        changed = replace(self, effects=tuple(effects))
        changed.__dict__["gravity"] = self.gravity
        return changed

    def with_background(self, background: Sequence[Effect]) -> Simulation:
        """The same with other small errors everywhere."""
        changed = replace(self, background=tuple(background))
        changed.__dict__["gravity"] = self.gravity
        return changed

    @cached_property
    def rigid(self) -> Simulation:
        """With those of its effects alone that a rigid chain can have in it, and without the residual."""
        own, background = (
            tuple(effect for effect in effects if effect.name in RIGID) for effects in (self.effects, self.background)
        )
        rigid = Simulation(self.robot, own, None, background)
        rigid.__dict__["gravity"] = self.gravity
        return rigid

    @property
    def since(self) -> Simulation:
        """The arm as it is since all moments have passed, standing still and cold.

        What jumped, slipped or was bumped stays where it is; what comes of motion or of warming up is not there.
        """
        stayed = self.after_moments
        return replace(stayed, effects=tuple(effect for effect in stayed.effects if effect.name not in _OF_MOTION))

    @property
    def after_moments(self) -> Simulation:
        """The same with what jumped, slipped or was bumped where it stays."""
        own = [effect for effect in self.effects if effect.name not in _STAYS]
        later = [
            Effect.at(self.robot, _STAYS[effect.name], effect.where, values=effect.values[:-1].tolist())
            for effect in self.effects
            if effect.name in _STAYS
        ]
        return replace(self, effects=(*own, *later))

    @property
    def placed(self) -> Simulation:
        """The same, with what the description calls not known in the description and no more among the effects.

        The camera's pose and the marker's place go there exactly: both are the frames at the ends of the chain.
        """
        robot, gone = self.robot, set[str]()
        pose, marker = robot.camera.pose, np.array(robot.robot.marker_xyz)
        if not robot.camera.pose_known and self._of("camera_pose"):
            pose, gone = pose @ self.camera_pose, gone | {"camera_pose"}
        if not robot.robot.marker_known and (shifts := self._of("tool_offset")):
            marker, gone = marker + sum(effect.values for effect in shifts), gone | {"tool_offset"}
        if not gone:
            return self
        effects = tuple(effect for effect in self.effects if effect.name not in gone)
        return replace(self, robot=robot.with_placement(pose, marker), effects=effects)

    def positions(self, motion: Motion) -> FloatArray:
        """What would be measured (n, 3) [m] in the measurement frame."""
        return self.run(motion).measured

    def run(self, motion: Motion) -> Simulated:
        """The pipeline, with all that is on the way."""
        readings = motion.earlier(self.latency_s)
        q = self.unloaded(readings)
        q += self.given_way(q)
        chain = self._chain()
        frames = chain.frames(q)
        marker = frames[:, -1]
        x_true = marker[:, :3, 3] + np.einsum("nij,nj->ni", marker[:, :3, :3], self.tool_shift(motion))
        x_placed = (x_true - self.camera_pose[:3, 3]) @ self.camera_pose[:3, :3]
        x_camera = x_placed
        if self._of("camera_moved"):
            T_placed_camera = self.camera_moves(motion)
            x_camera = np.einsum("nji,nj->ni", T_placed_camera[:, :3, :3], x_placed - T_placed_camera[:, :3, 3])
        measured = self.optics.reported(x_camera, self.robot.calibration) + self.added(motion)
        return Simulated(self, motion, readings, q, chain, frames, x_true, x_placed, x_camera, measured)

    def unloaded(self, readings: Motion) -> FloatArray:
        """True joint angles (n, d) [rad, m] where no weight bends the joints."""
        q = readings.q.copy()
        for effect in self.all_effects:
            if effect.kind.encoder is not None:
                place = self.place(effect)
                q[:, place.joint] += effect.kind.encoder.correction(readings, place, effect.values)
        return q

    def place(self, effect: Effect) -> Place:
        """Where an effect of the first stage sits."""
        assert effect.where is not None
        source = None if effect.source is None else self.robot.joints.index(effect.source)
        return Place(self.robot.joints.index(effect.where), effect.prismatic, source)

    @cached_property
    def optics(self) -> Optics:
        """The cameras' errors."""
        return Optics(
            sum(e.value("scale_error") for e in self._of("camera_scale")),
            sum(e.value("focal_error") for e in self._of("camera_focal")),
            sum(e.value("k1") for e in self._of("lens_distortion")),
            sum(e.value("k2") for e in self._of("lens_distortion")),
        )

    @property
    def latency_s(self) -> float:
        """How late the images' time stamps are [s]."""
        return sum(e.value("latency_s") for e in self._of("camera_latency"))

    def _of(self, name: str) -> list[Effect]:
        return [effect for effect in self.all_effects if effect.name == name]

    @property
    def bears_weight(self) -> bool:
        """Whether the joints bear the arm's weight; where they are torque-free, the guiding hand does."""
        return self.robot.robot.hold != "torque_free"

    def given_way(self, q: FloatArray) -> FloatArray:
        """How far the joints give under the arm's weight (n, d) [rad, m], their springs unloaded at q (n, d)."""
        springs = np.zeros(q.shape[1])
        for effect in self._of("joint_compliance"):
            springs[self.place(effect).joint] += effect.values[0]
        given = np.zeros_like(q)
        if springs.any() and self.bears_weight:
            for _ in range(_SPRING_ROUNDS):
                given = springs * self.gravity.torques(q + given)
        return given

    @property
    def rigid_chain(self) -> RigidChain:
        """The chain from camera to marker with the effects that it can have in it, over the readings."""
        rigid = self.rigid
        chain = rigid._chain()
        fixed = chain.fixed.copy()
        fixed[0] = inverse(rigid.camera_pose) @ fixed[0]
        for effect in rigid.all_effects:
            if effect.name == "joint_offset":
                k = rigid.place(effect).joint
                fixed[k] = fixed[k] @ self._turned(k, effect.values[0])
            elif effect.name == "tool_offset":
                fixed[-1, :3, 3] += fixed[-1, :3, :3] @ effect.values
        return RigidChain(fixed, chain.axes, chain.prismatic)

    def _turned(self, joint: int, value: float) -> FloatArray:
        """A joint's own motion (4, 4) along the way from camera to marker."""
        chain, none = self.robot.chain, np.zeros(3)
        along = value * chain.axes[joint]
        return transforms(np.concatenate([along, none] if chain.prismatic[joint] else [none, along])[None])[0]

    def _chain(self) -> RigidChain:
        """The chain with its links as they are."""
        chain = self.robot.chain
        fixed = chain.fixed.copy()
        for k, moved in self.link_moves:
            if self.upward[k]:
                fixed[k + 1] = inverse(moved) @ fixed[k + 1]
            else:
                fixed[k] = fixed[k] @ moved
        return RigidChain(fixed, chain.axes, chain.prismatic)

    @cached_property
    def link_moves(self) -> list[tuple[int, FloatArray]]:
        """By how much joints' frames are moved: the place in q, and the pose (4, 4) in the frame of the drawing."""
        return [(self.place(effect).joint, transforms(effect.values[None])[0]) for effect in self._of("link_geometry")]

    @cached_property
    def upward(self) -> list[bool]:
        """Which joints are walked from child to parent on the way from camera to marker (d,)."""
        way = self.robot.tree.path(self.robot.camera.parent_link, self.robot.robot.marker_link)
        return [upward for joint, upward in way if joint.name in self.robot.joints]

    def tool_shift(self, motion: Motion) -> FloatArray:
        """How far the marker is from its place (n, 3) [m], in its link."""
        shift = np.zeros((len(motion), 3))
        for effect in self._of("tool_offset"):
            shift += effect.values
        for effect in self._of("tool_slip"):
            shift[after(motion, effect)] += effect.values[:3]
        return shift

    @property
    def camera_pose(self) -> FloatArray:
        """Where the camera was set up (4, 4), in the frame that the description gives it."""
        T = np.eye(4)
        for effect in self._of("camera_pose"):
            T = T @ transforms(effect.values[None])[0]
        return T

    def camera_moves(self, motion: Motion) -> FloatArray:
        """Where the camera is (n, 4, 4) in its frame where it was set up."""
        T = np.tile(np.eye(4), (len(motion), 1, 1))
        for effect in self._of("camera_moved"):
            T[after(motion, effect)] @= transforms(effect.values[None, :6])[0]
        return T

    def added(self, motion: Motion) -> FloatArray:
        """What is added to what the cameras report (n, 3) [m]: drift and residual."""
        shift = np.zeros((len(motion), 3)) if self.residual is None else self.residual.predict(motion.q)
        for effect in self._of("thermal_drift"):
            shift = shift + settled(motion, effect.values[3])[:, None] * effect.values[:3]
        return shift
