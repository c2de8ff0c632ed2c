"""Simulate a robot as a pipeline: encoder, structure, tool, camera, time; the nominal model with effects added.

x_measured = drift(t) + residual(q(t)) + optics(camera(tool(structure(encoder(q(t - latency))))))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.urdf import inverse
from kbmaps import RigidChain

from .effect import Effect, Identity
from .encoder import Place
from .flank import flanks
from .gravity import GravityLoad
from .moments import after, settled
from .motion import Motion
from .optics import Optics
from .poses import transforms
from .simulated import Simulated

# A spring's deflection changes its own load; each round adds the next order.
_SPRING_ROUNDS = 3
# Effects that a rigid chain can hold.
RIGID = ("joint_offset", "link_geometry", "tool_offset", "camera_pose")
# Permanent form of effects with a moment; effects that exist only in motion.
_STAYS = {"encoder_jump": "joint_offset", "tool_slip": "tool_offset", "camera_moved": "camera_pose"}
_OF_MOTION = ("backlash", "settling", "hysteresis", "camera_latency", "thermal_drift")


class Residual(Protocol):
    """A smooth function of the readings for errors that no effect explains."""

    def predict(self, q: FloatArray) -> FloatArray:
        """Return the difference (n, 3) [m] of measurements from the effects, at the readings q (n, d) [rad, m]."""
        ...


@dataclass(frozen=True, eq=False)
class Simulation:
    """A robot with effects, and the measurements that its cameras would report.

    Attributes:
        robot: the robot as described.
        effects: effects added to it.
        residual: correction added to the measurements; None for none. It depends on the readings alone, so no effect
            changes it.
        background: small errors everywhere, within manufacturing tolerances; never a finding.
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
        """Torques of gravity about the joints."""
        return GravityLoad(self.robot)

    def with_effects(self, effects: Sequence[Effect]) -> Simulation:
        """Return the same robot and residual with other effects."""
        changed = replace(self, effects=tuple(effects))
        changed.__dict__["gravity"] = self.gravity
        return changed

    def with_background(self, background: Sequence[Effect]) -> Simulation:
        """Return the same simulation with another background."""
        changed = replace(self, background=tuple(background))
        changed.__dict__["gravity"] = self.gravity
        return changed

    @cached_property
    def rigid(self) -> Simulation:
        """The simulation with only the effects that a rigid chain can hold, and without the residual."""
        own, background = (
            tuple(effect for effect in effects if effect.name in RIGID) for effects in (self.effects, self.background)
        )
        rigid = Simulation(self.robot, own, None, background)
        rigid.__dict__["gravity"] = self.gravity
        return rigid

    @property
    def since(self) -> Simulation:
        """The arm after all moments have passed, at rest and cold.

        Jumps, slips and bumps stay; effects of motion or of warming up are removed.
        """
        stayed = self.after_moments
        return replace(stayed, effects=tuple(effect for effect in stayed.effects if effect.name not in _OF_MOTION))

    @property
    def after_moments(self) -> Simulation:
        """The same simulation with jumps, slips and bumps made permanent."""
        own = [effect for effect in self.effects if effect.name not in _STAYS]
        later = [
            Effect.at(self.robot, _STAYS[effect.name], effect.where, values=effect.values[:-1].tolist())
            for effect in self.effects
            if effect.name in _STAYS
        ]
        return replace(self, effects=(*own, *later))

    @property
    def placed(self) -> Simulation:
        """The same simulation, with fitted values of unknown parameters moved from the effects to the description.

        This is exact for the camera's pose and the marker's position: both are the frames at the ends of the chain.
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
        """Return the simulated measurements (n, 3) [m] in the measurement frame."""
        return self.run(motion).measured

    def run(self, motion: Motion) -> Simulated:
        """Run the pipeline, keeping all intermediate results."""
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
        """Return true joint angles (n, d) [rad, m] without deflection under weight."""
        q = readings.q.copy()
        for effect in self.all_effects:
            if effect.kind.encoder is not None:
                place = self.place(effect)
                q[:, place.joint] += effect.kind.encoder.correction(readings, place, effect.values)
        return q

    def place(self, effect: Effect) -> Place:
        """Return the place of an effect of the first stage."""
        assert effect.where is not None
        source = None if effect.source is None else self.robot.joints.index(effect.source)
        return Place(self.robot.joints.index(effect.where), effect.prismatic, source)

    @cached_property
    def optics(self) -> Optics:
        """Errors of the cameras."""
        return Optics(
            sum(e.value("scale_error") for e in self._of("camera_scale")),
            sum(e.value("focal_error") for e in self._of("camera_focal")),
            sum(e.value("k1") for e in self._of("lens_distortion")),
            sum(e.value("k2") for e in self._of("lens_distortion")),
        )

    @property
    def latency_s(self) -> float:
        """Delay of the images' time stamps [s]."""
        return sum(e.value("latency_s") for e in self._of("camera_latency"))

    def _of(self, name: str) -> list[Effect]:
        return [effect for effect in self.all_effects if effect.name == name]

    @property
    def bears_weight(self) -> bool:
        """True if the joints bear the arm's weight; torque-free joints leave it to the guiding hand."""
        return self.robot.robot.hold != "torque_free"

    def given_way(self, q: FloatArray, hung: dict[Identity, float] | None = None) -> FloatArray:
        """Return the deflection of the joints under the arm's weight (n, d) [rad, m], their springs unloaded at q (n,
        d).

        Args:
            hung: flank of each loaded backlash before the first row, updated to the last; None if unknown.
        """
        given = np.zeros_like(q)
        if not self.bears_weight:
            return given
        if self.springs.any():
            for _ in range(_SPRING_ROUNDS):
                given = self.springs * self.torques(q + given)
        if loose := self._of("gravity_backlash"):
            torques, sides = self.torques(q + given), {} if hung is None else hung
            for effect in loose:
                k = self.place(effect).joint
                side = flanks(torques[:, k], float(effect.values[1]), sides.get(effect.identity, 0.0))
                given[:, k] += 0.5 * effect.values[0] * side
                sides[effect.identity] = float(side[-1])
        return given

    @cached_property
    def springs(self) -> FloatArray:
        """Compliance of each joint (d,) [rad/(N·m), m/N]."""
        springs = np.zeros(len(self.robot.joints))
        for effect in self._of("joint_compliance"):
            springs[self.place(effect).joint] += effect.values[0]
        return springs

    def torques(self, q: FloatArray) -> FloatArray:
        """Return torques of gravity about the joints (n, d) [N·m, N], with payloads, at q (n, d)."""
        return sum((load.torques(q) for load in self._payloads), self.gravity.torques(q))

    @cached_property
    def _payloads(self) -> list[GravityLoad]:
        return [
            GravityLoad.of_payload(self.robot, float(effect.values[0]), effect.values[1:])
            for effect in self._of("payload")
            if effect.values.any()
        ]

    @property
    def rigid_chain(self) -> RigidChain:
        """Chain from camera to marker with the effects that it can hold, over the readings."""
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
        """Return a joint's own motion (4, 4) along the path from camera to marker."""
        chain, none = self.robot.chain, np.zeros(3)
        along = value * chain.axes[joint]
        return transforms(np.concatenate([along, none] if chain.prismatic[joint] else [none, along])[None])[0]

    def _chain(self) -> RigidChain:
        """Return the chain with corrected links."""
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
        """Corrections of joint frames: the index in q, and the pose (4, 4) in the nominal frame."""
        return [(self.place(effect).joint, transforms(effect.values[None])[0]) for effect in self._of("link_geometry")]

    @cached_property
    def upward(self) -> list[bool]:
        """True for joints passed from child to parent on the path from camera to marker (d,)."""
        way = self.robot.tree.path(self.robot.camera.parent_link, self.robot.robot.marker_link)
        return [upward for joint, upward in way if joint.name in self.robot.joints]

    def tool_shift(self, motion: Motion) -> FloatArray:
        """Return the displacement of the marker from its nominal position (n, 3) [m], in its link."""
        shift = np.zeros((len(motion), 3))
        for effect in self._of("tool_offset"):
            shift += effect.values
        for effect in self._of("tool_slip"):
            shift[after(motion, effect)] += effect.values[:3]
        return shift

    @property
    def camera_pose(self) -> FloatArray:
        """Initial camera pose (4, 4), in the frame that the description gives it."""
        T = np.eye(4)
        for effect in self._of("camera_pose"):
            T = T @ transforms(effect.values[None])[0]
        return T

    def camera_moves(self, motion: Motion) -> FloatArray:
        """Return the camera's pose (n, 4, 4) in its initial frame."""
        T = np.tile(np.eye(4), (len(motion), 1, 1))
        for effect in self._of("camera_moved"):
            T[after(motion, effect)] @= transforms(effect.values[None, :6])[0]
        return T

    def added(self, motion: Motion) -> FloatArray:
        """Return the shift added to the camera's report (n, 3) [m]: drift and residual."""
        shift = np.zeros((len(motion), 3)) if self.residual is None else self.residual.predict(motion.q)
        for effect in self._of("thermal_drift"):
            shift = shift + settled(motion, effect.values[3])[:, None] * effect.values[:3]
        return shift
