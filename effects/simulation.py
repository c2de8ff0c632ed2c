"""Simulate a robot as a pipeline: encoder, structure, tool, camera, time; the nominal model with effects added.

x_measured = drift(t) + residual(q(t)) + optics(camera(tool(structure(encoder(q(t - latency))))))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from bodyschema.effects.motion import crossed, transforms
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.urdf import inverse
from kbmaps import RigidChain

from .effect_type import (
    STAGES,
    CameraEffect,
    Effect,
    EffectSettings,
    EffectType,
    Identity,
    Stage,
    StructureEffect,
    TimeEffect,
    ToolEffect,
)
from .encoder import EncoderEffect
from .gravity import GravityLoad
from .moments import after, since
from .motion import Motion
from .optics import Optics
from .parameter import Place


class SimulationSettings:
    shape_step = 1e-3  # relative step by a period or a time constant
    spring_rounds = 3  # a spring's deflection changes its own load; each round adds the next order


# Corrections (n,) of readings by the encoder effects that were evaluated there, as long as both live.
_CORRECTIONS: WeakKeyDictionary[Motion, WeakKeyDictionary[Effect, FloatArray]] = WeakKeyDictionary()
# Predictions (n, 3) of residuals, which no effect changes, as long as both live.
_RESIDUALS: WeakKeyDictionary[Motion, WeakKeyDictionary[Residual, FloatArray]] = WeakKeyDictionary()
Staged = TypeVar("Staged", bound=EffectType)


class _BackgroundResult(NamedTuple):
    """The chain, and joint angles (n, d) from the readings, with the background as the only effects."""

    chain: RigidChain
    angles: WeakKeyDictionary[Motion, FloatArray]


class Residual(Protocol):
    """A smooth function of the readings for errors that no effect explains."""

    def predict(self, q: FloatArray) -> FloatArray:
        """Return the difference (n, 3) [m] between measurements and effects, at the readings q (n, d) [rad, m]."""
        ...


@dataclass(frozen=True, eq=False)
class Simulation:
    """A robot with effects, and the measurements that its cameras would report."""

    robot: RobotDescription  # the robot as described
    effects: tuple[Effect, ...] = ()  # effects added to it
    # correction added to the measurements; None for none. It depends on the readings alone, so no effect changes it.
    residual: Residual | None = None
    background: tuple[Effect, ...] = ()  # small errors everywhere, within manufacturing tolerances; never a finding

    @cached_property
    def all_effects(self) -> tuple[Effect, ...]:
        return (*self.background, *self.effects)

    @cached_property
    def gravity(self) -> GravityLoad:
        return GravityLoad(self.robot)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to be pickled, without weak references, whose targets are computed again."""
        return {name: value for name, value in self.__dict__.items() if name != "_beneath"}

    def with_effects(self, effects: Sequence[Effect]) -> Simulation:
        changed = replace(self, effects=tuple(effects))
        changed.__dict__.update(gravity=self.gravity, _beneath=self._beneath)
        return changed

    def with_background(self, background: Sequence[Effect]) -> Simulation:
        changed = replace(self, background=tuple(background))
        changed.__dict__["gravity"] = self.gravity
        return changed

    @cached_property
    def rigid(self) -> Simulation:
        """The simulation with only the effects that a rigid chain can hold, and without the residual."""
        kept_effects, background = (
            tuple(effect for effect in effects if effect.kind.rigid) for effects in (self.effects, self.background)
        )
        rigid = Simulation(self.robot, kept_effects, None, background)
        rigid.__dict__["gravity"] = self.gravity
        return rigid

    @property
    def since(self) -> Simulation:
        """The arm after all moments have passed, at rest and cold.

        Jumps, slips and bumps stay; effects of motion or of warming up are removed.
        """
        permanent = self.with_permanent_changes
        return replace(permanent, effects=tuple(effect for effect in permanent.effects if not effect.kind.is_transient))

    @property
    def with_permanent_changes(self) -> Simulation:
        """The same simulation with jumps, slips and bumps made permanent."""
        own = [effect for effect in self.effects if effect.kind.stays_as is None]
        later = [
            Effect.at(self.robot, effect.kind.stays_as, effect.where, values=effect.values[:-1].tolist())
            for effect in self.effects
            if effect.kind.stays_as is not None
        ]
        return replace(self, effects=(*own, *later))

    @property
    def placed(self) -> Simulation:
        """The same simulation, with fitted values of unknown parameters moved from the effects to the description.

        This is exact for the camera's pose and the marker's position: both are the frames at the ends of the chain.
        """
        robot = self.robot
        if not any(effect.kind.is_free(robot) for effect in self.all_effects):
            return self
        pose, marker = robot.camera.pose, np.array(robot.robot.marker_xyz)
        for effect in self.all_effects:
            if not effect.kind.is_free(robot):
                continue
            if isinstance(effect.kind, CameraEffect) and (moved := effect.pose) is not None:
                pose = pose @ moved
            elif isinstance(effect.kind, ToolEffect):
                marker = marker + effect.kind.shift(effect.values)
        effects = tuple(effect for effect in self.effects if not effect.kind.is_free(robot))
        return replace(self, robot=robot.with_placement(pose, marker), effects=effects)

    def with_effect(self, effect: Effect) -> Simulation:
        """Return the same simulation with an effect added, or replaced by identity."""
        own, background = (
            tuple(effect if one.identity == effect.identity else one for one in effects)
            for effects in (self.effects, self.background)
        )
        if effect not in (*own, *background):
            own = (*own, effect)
        return self.with_effects(own).with_background(background)

    def positions(self, motion: Motion) -> FloatArray:
        """Return the simulated measurements (n, 3) [m] in the measurement frame."""
        return self.run(motion).measured

    def run(self, motion: Motion) -> PipelineRun:
        """Run the pipeline, keeping all intermediate results."""
        readings = motion.earlier(self.latency_s)
        q = self.unloaded(readings)
        q += self.deflections(q)
        chain = self._chain()
        frames = chain.frames(q)
        marker = frames[:, -1]
        x_true = marker[:, :3, 3] + np.einsum("nij,nj->ni", marker[:, :3, :3], self.tool_shift(motion))
        x_placed = (x_true - self.camera_pose[:3, 3]) @ self.camera_pose[:3, :3]
        x_camera = x_placed
        if any(effect.kind.begins for effect, _ in self._effects_of(CameraEffect)):
            T_placed_camera = self.camera_moves(motion)
            x_camera = np.einsum("nji,nj->ni", T_placed_camera[:, :3, :3], x_placed - T_placed_camera[:, :3, 3])
        measured = self.reported(x_camera, motion) + self.added(motion)
        return PipelineRun(self, motion, readings, q, chain, frames, x_true, x_placed, x_camera, measured)

    def unloaded(self, readings: Motion) -> FloatArray:
        """Return true joint angles (n, d) [rad, m] without deflection under weight."""
        beneath = self._beneath.angles
        if readings not in beneath:
            beneath[readings] = self._corrected(readings, readings.q, self.background)
        return self._corrected(readings, beneath[readings], self.effects)

    def _corrected(self, readings: Motion, angles: FloatArray, effects: Sequence[Effect]) -> FloatArray:
        """Return joint angles (n, d) [rad, m] with the corrections of some effects added."""
        q = angles.copy()
        for effect in effects:
            if isinstance(effect.kind, EncoderEffect):
                place, known = self.place(effect), _CORRECTIONS.setdefault(readings, WeakKeyDictionary())
                if effect not in known:
                    known[effect] = effect.kind.correction(readings, place, effect.values)
                q[:, place.joint] += known[effect]
        return q

    @cached_property
    def _beneath(self) -> _BackgroundResult:
        """The result of the background alone, which is the same with other effects."""
        return _BackgroundResult(self._with_link_corrections(self.robot.chain, self.background), WeakKeyDictionary())

    def place(self, effect: Effect) -> Place:
        """Return the place of an effect of the first stage."""
        assert effect.where is not None
        source = None if effect.source is None else self.robot.joints.index(effect.source)
        return Place(self.robot.joints.index(effect.where), effect.prismatic, source)

    def reported(self, x: FloatArray, motion: Motion, optics: Optics | None = None) -> FloatArray:
        """Return the positions (n, 3) [m] that the camera reports of points x (n, 3) in its present frame.

        Args:
            optics: optics instead of its own.
        """
        return self.altered((self.optics if optics is None else optics).reported(x, self.robot.calibration), motion)

    def altered(self, x: FloatArray, motion: Motion) -> FloatArray:
        """Return the reported positions (n, 3) [m] of points x (n, 3), altered by effects beyond the optics."""
        for effect, kind in self._effects_of(CameraEffect):
            if kind.alters_report:
                x = kind.reported(x, motion, effect.values, self.robot.calibration)
        return x

    @cached_property
    def alters_report(self) -> bool:
        """True if an effect beyond the optics alters the camera's report."""
        return any(kind.alters_report for _, kind in self._effects_of(CameraEffect))

    @cached_property
    def optics(self) -> Optics:
        parts = [kind.optics(effect.values) for effect, kind in self._effects_of(CameraEffect)]
        return sum((part for part in parts if part is not None), Optics())

    @property
    def latency_s(self) -> float:
        """Delay of the images' timestamps [s]."""
        return sum(kind.delay_s(effect.values) for effect, kind in self._effects_of(TimeEffect))

    def _effects_of(self, stage: type[Staged]) -> list[tuple[Effect, Staged]]:
        return [
            (effect, effect.kind) for effect in self._effects_by_stage[stage.stage] if isinstance(effect.kind, stage)
        ]

    @cached_property
    def _effects_by_stage(self) -> dict[Stage, list[Effect]]:
        staged: dict[Stage, list[Effect]] = {stage: [] for stage in STAGES}
        for effect in self.all_effects:
            staged[effect.kind.stage].append(effect)
        return staged

    @property
    def bears_weight(self) -> bool:
        """True if the joints bear the arm's weight; without torque, the guiding hand bears it."""
        return self.robot.robot.hold != "torque_free"

    @property
    def shows_weight(self) -> bool:
        """True if the weight may matter: the joints bear it, or the URDF states it and its supports may deflect."""
        return self.bears_weight or self.gravity.known

    def deflections(self, q: FloatArray, flanks: dict[Identity, float] | None = None) -> FloatArray:
        """Return the joints' deflection under the arm's weight (n, d) [rad, m], their springs unloaded at q (n, d).

        Args:
            flanks: flank of each loaded backlash before the first row, updated to the last; None if unknown.
        """
        deflection = np.zeros_like(q)
        if not self.bears_weight:
            return deflection
        if self.springs.any():
            for _ in range(SimulationSettings.spring_rounds):
                deflection = self.springs * self.torques(q + deflection)
        loose = [(effect, kind) for effect, kind in self._effects_of(StructureEffect) if kind.has_slack]
        torques, sides = self.torques(q + deflection) if loose else deflection, {} if flanks is None else flanks
        for effect, kind in loose:
            k = self.place(effect).joint
            slack, side = kind.slack(torques[:, k], effect.values, sides.get(effect.identity, 0.0))
            deflection[:, k] += slack
            sides[effect.identity] = side
        return deflection

    @cached_property
    def springs(self) -> FloatArray:
        """Compliance of each joint (d,) [rad/(N·m), m/N]."""
        springs = np.zeros(len(self.robot.joints))
        for effect, kind in self._effects_of(StructureEffect):
            if effect.where is not None:
                springs[self.place(effect).joint] += kind.compliance(effect.values)
        return springs

    def torques(self, q: FloatArray) -> FloatArray:
        """Return torques of gravity about the joints (n, d) [N·m, N], with payloads, at q (n, d)."""
        return sum((load.torques(q) for load in self.payloads), self.gravity.torques(q))

    @cached_property
    def payloads(self) -> list[GravityLoad]:
        loads = [kind.load(self.gravity, effect.values) for effect, kind in self._effects_of(StructureEffect)]
        return [load for load in loads if load is not None]

    @property
    def rigid_chain(self) -> RigidChain:
        """Chain from camera to marker with the effects that it can hold, over the readings."""
        rigid = self.rigid
        chain = rigid._chain()
        fixed = chain.fixed.copy()
        fixed[0] = inverse(rigid.camera_pose) @ fixed[0]
        for effect in rigid.all_effects:
            if effect.kind.is_zero:
                k = rigid.place(effect).joint
                fixed[k] = fixed[k] @ self._turned(k, effect.values[0])
            elif isinstance(effect.kind, ToolEffect):
                fixed[-1, :3, 3] += fixed[-1, :3, :3] @ effect.kind.shift(effect.values)
        return RigidChain(fixed, chain.axes, chain.prismatic)

    def _turned(self, joint: int, value: float) -> FloatArray:
        """Return a joint's own motion (4, 4) along the path from camera to marker."""
        chain, none = self.robot.chain, np.zeros(3)
        along = value * chain.axes[joint]
        return transforms(np.concatenate([along, none] if chain.prismatic[joint] else [none, along])[None])[0]

    def _chain(self) -> RigidChain:
        return self._with_link_corrections(self._beneath.chain, self.effects)

    def _with_link_corrections(self, chain: RigidChain, effects: Sequence[Effect]) -> RigidChain:
        """Return a chain with the corrections of its links by some effects."""
        moves = self._link_moves(effects)
        if not moves:
            return chain
        fixed = chain.fixed.copy()
        for k, moved in moves:
            if self.upward[k]:
                fixed[k + 1] = inverse(moved) @ fixed[k + 1]
            else:
                fixed[k] = fixed[k] @ moved
        return RigidChain(fixed, chain.axes, chain.prismatic)

    @property
    def link_moves(self) -> list[tuple[int, FloatArray]]:
        """Corrections of joint frames: the index in q, and the pose (4, 4) in the nominal frame."""
        return self._link_moves(self.all_effects)

    def _link_moves(self, effects: Sequence[Effect]) -> list[tuple[int, FloatArray]]:
        return [(self.place(effect).joint, effect.frame) for effect in effects if effect.frame is not None]

    @cached_property
    def upward(self) -> list[bool]:
        """True for joints passed from child to parent on the path from camera to marker (d,)."""
        path = self.robot.tree.path(self.robot.camera.parent_link, self.robot.robot.marker_link)
        upward = {joint.name: is_upward for joint, is_upward in path}
        return [upward[name] for name in upward if name in self.robot.joints]

    def tool_shift(self, motion: Motion) -> FloatArray:
        """Return the displacement of the marker from its nominal position (n, 3) [m], in its link."""
        shift = np.zeros((len(motion), 3))
        for effect, kind in self._effects_of(ToolEffect):
            shift[after(motion, effect) if kind.begins else slice(None)] += kind.shift(effect.values)
        return shift

    @cached_property
    def camera_pose(self) -> FloatArray:
        """Initial camera pose (4, 4), in the frame that the description gives it."""
        T = np.eye(4)
        for effect, kind in self._effects_of(CameraEffect):
            if not kind.begins and (pose := effect.pose) is not None:
                T = T @ pose
        return T

    def camera_moves(self, motion: Motion) -> FloatArray:
        """Return the camera's pose (n, 4, 4) in its initial frame."""
        T = np.tile(np.eye(4), (len(motion), 1, 1))
        for effect, kind in self._effects_of(CameraEffect):
            if kind.begins and (pose := effect.pose) is not None:
                T[after(motion, effect)] @= pose
        return T

    def added(self, motion: Motion) -> FloatArray:
        """Return the shift added to the camera's report (n, 3) [m]: drift and residual."""
        shift = np.zeros((len(motion), 3))
        if self.residual is not None:
            known = _RESIDUALS.setdefault(motion, WeakKeyDictionary())
            if self.residual not in known:
                known[self.residual] = self.residual.predict(motion.q)
            shift = known[self.residual]
        for effect, kind in self._effects_of(TimeEffect):
            drift = kind.drift(motion, effect.values)
            if drift is not None:
                shift = shift + drift
        return shift


@dataclass(frozen=True, eq=False)
class PipelineRun:
    """One run of the pipeline, with its derivatives by each effect's parameters."""

    simulation: Simulation
    motion: Motion
    readings: Motion  # encoder readings at the time of the images
    q: FloatArray  # true joint angles (n, d) [rad, m]
    chain: RigidChain
    frames: FloatArray  # frames of the joints and the marker (n, d + 1, 4, 4) in the nominal camera's frame
    # x_true, x_placed, x_camera: the marker (n, 3) [m] seen by the nominal camera, by the camera as it was set up, and
    # by the camera at its present pose
    x_true: FloatArray
    x_placed: FloatArray
    x_camera: FloatArray
    measured: FloatArray  # simulated measurements (n, 3) [m]

    @cached_property
    def by_joint(self) -> FloatArray:
        """Derivatives (n, 3, d) of the measurements by the true joint angles [m/rad, m/m]."""
        chain, frames = self.chain, self.frames
        joints = np.moveaxis(frames[:, :-1, :3], 1, 3)
        axes = (joints[:, :, :3] * chain.axes.T).sum(axis=2)
        return self.seen(np.where(chain.prismatic, axes, crossed(axes, self.x_true[:, :, None] - joints[:, :, 3])))

    @cached_property
    def torques(self) -> FloatArray:
        """Torques of gravity (n, d) [N·m, N]."""
        return self.simulation.torques(self.q)

    @cached_property
    def wrenches(self) -> FloatArray:
        """Loads of gravity on the parts that each joint carries (n, d, 6), in the joint's frame on its parent link.

        These are moments about its origin [N·m], then forces [N].
        """
        return np.concatenate(self.simulation.gravity.loads(self.q), axis=2)

    def columns(self, effect: Effect) -> FloatArray:
        """Return derivatives (n, 3, p) of the measurements by the effect's values; zeros for those not amounts."""
        return effect.kind.jacobian(self, effect)

    def by_shape(self, effect: Effect) -> FloatArray:
        """Return derivatives (n, 3, s) of the measurements by the effect's `shapes`."""
        derivatives = []
        for k in effect.shapes:
            step = np.zeros(len(effect.values))
            step[k] = SimulationSettings.shape_step * (abs(effect.values[k]) or 1.0)
            above, below = (self.columns(effect.with_values(effect.values + sign * step)) for sign in (1.0, -1.0))
            change = (above - below)[:, :, effect.amounts] @ effect.values[effect.amounts]
            derivatives.append(change / (2.0 * step[k]))
        return np.stack(derivatives, axis=2) if derivatives else np.empty((len(self.q), 3, 0))

    @cached_property
    def by_marker(self) -> FloatArray:
        """Derivatives (n, 3, 3) of the measurements by the marker's position in its link."""
        return self.seen(self.frames[:, -1, :3, :3])

    def by_optics(self, effect: Effect) -> FloatArray:
        """Return derivatives (n, 3, p) of the measurements by an effect's values, each one a number of the optics."""
        simulation, optics = self.simulation, self.simulation.optics
        columns = []
        for parameter in effect.parameters:
            number = getattr(optics, parameter.name)
            both = EffectSettings.step, -EffectSettings.step
            more, less = (replace(optics, **{parameter.name: number + step}) for step in both)
            change = simulation.reported(self.x_camera, self.motion, more)
            change = change - simulation.reported(self.x_camera, self.motion, less)
            columns.append(change / (2.0 * EffectSettings.step))
        return np.stack(columns, axis=2)

    def by_report(self, effect: Effect) -> FloatArray:
        """Return derivatives (n, 3, p) by the values of an effect on the camera's report, by differences."""
        columns = np.zeros((len(self.motion), 3, len(effect.values)))
        for k in effect.all_amounts:
            step = np.zeros(len(effect.values))
            step[k] = EffectSettings.step
            ends = (self.simulation.with_effect(effect.with_values(effect.values + s * step)) for s in (1.0, -1.0))
            more, less = (simulation.reported(self.x_camera, self.motion) for simulation in ends)
            columns[:, :, k] = (more - less) / (2.0 * EffectSettings.step)
        return columns

    def seen(self, moved: FloatArray) -> FloatArray:
        """Return the change of the measurements by moves (n, 3, p) [m] of the point in the nominal camera's frame."""
        for effect in self.simulation.effects:
            if (pose := effect.pose) is not None and not effect.kind.begins:
                moved = pose[:3, :3].T @ moved
        return self.optical(self.since_moved(moved))

    def since_moved(self, moved: FloatArray) -> FloatArray:
        """Return moves (n, 3, p) in the present camera frame, from moves in its initial frame."""
        for effect in self.simulation.effects:
            if (pose := effect.pose) is not None and effect.kind.begins:
                moved = np.where(since(self.motion, effect) > 0.0, pose[:3, :3].T @ moved, moved)
        return moved

    def optical(self, moved: FloatArray) -> FloatArray:
        """Return the change of the measurements by moves (n, 3, p) of the point in the camera's frame [m]."""
        optics = self.simulation.optics
        if not optics.inside and not self.simulation.alters_report:
            return moved * (1.0 + optics.scale_error)
        return np.einsum("nij,njp->nip", self._by_point, moved)

    @cached_property
    def _by_point(self) -> FloatArray:
        """Derivatives (n, 3, 3) of the reported position by the point."""
        reported = self.simulation.reported
        changes = [
            reported(self.x_camera + step, self.motion) - reported(self.x_camera - step, self.motion)
            for step in EffectSettings.step * np.eye(3)
        ]
        return np.stack(changes, axis=2) / (2.0 * EffectSettings.step)
