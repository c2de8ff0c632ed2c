"""Simulate a robot as a pipeline: encoder, structure, tool, camera, time; the nominal model with effects added.

x_measured = drift(t) + residual(q(t)) + optics(camera(tool(structure(encoder(q(t - latency))))))
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Protocol

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
from .poses import rotation, transforms

# Step of numerical derivatives by the optics' parameters and by a point.
_STEP = 1e-6
# Step by a latency [s].
_STEP_S = 1e-5
# Relative step by a period or a time constant.
_SHAPE_STEP = 1e-3
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
        return sum((load.torques(q) for load in self.payloads), self.gravity.torques(q))

    @cached_property
    def payloads(self) -> list[GravityLoad]:
        """Loads that the URDF lacks."""
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


@dataclass(frozen=True, eq=False)
class Simulated:
    """One run of the pipeline, with its derivatives by each effect's parameters.

    Attributes:
        readings: encoder readings at the time of the images.
        q: true joint angles (n, d) [rad, m].
        frames: frames of the joints and the marker (n, d + 1, 4, 4) in the nominal camera's frame.
        x_true, x_placed, x_camera: the marker (n, 3) [m] seen by the nominal camera, by the camera as it was set up,
            and by the camera at its present pose.
        measured: simulated measurements (n, 3) [m].
    """

    simulation: Simulation
    motion: Motion
    readings: Motion
    q: FloatArray
    chain: RigidChain
    frames: FloatArray
    x_true: FloatArray
    x_placed: FloatArray
    x_camera: FloatArray
    measured: FloatArray

    @cached_property
    def by_joint(self) -> FloatArray:
        """Derivatives (n, 3, d) of the measurements by the true joint angles [m/rad, m/m]."""
        chain, frames = self.chain, self.frames
        axes = np.einsum("nkij,kj->nki", frames[:, :-1, :3, :3], chain.axes)
        levers = self.x_true[:, None] - frames[:, :-1, :3, 3]
        moved = np.where(chain.prismatic[:, None], axes, np.cross(axes, levers))
        return self._seen(np.swapaxes(moved, 1, 2))

    @cached_property
    def torques(self) -> FloatArray:
        """Torques of gravity (n, d) [N·m, N]."""
        return self.simulation.torques(self.q)

    @cached_property
    def wrenches(self) -> FloatArray:
        """Loads of gravity on what each joint carries (n, d, 6), in the joint's frame on its parent link.

        These are moments about its origin [N·m], then forces [N].
        """
        return np.concatenate(self.simulation.gravity.loads(self.q), axis=2)

    def columns(self, effect: Effect) -> FloatArray:
        """Return derivatives (n, 3, p) of the measurements by the effect's values; zeros for values that are not
        amounts.
        """
        simulation = self.simulation
        if effect.kind.encoder is not None:
            place = simulation.place(effect)
            by_value = effect.kind.encoder.columns(self.readings, place, effect.values)
            return self.by_joint[:, :, [place.joint]] * by_value[:, None, :]
        return self._BY_NAME[effect.name](self, effect)

    def by_shape(self, effect: Effect) -> FloatArray:
        """Return derivatives (n, 3, s) of the measurements by the effect's `shapes`."""
        derivatives = []
        for k in effect.shapes:
            step = np.zeros(len(effect.values))
            step[k] = _SHAPE_STEP * (abs(effect.values[k]) or 1.0)
            above, below = (self.columns(effect.with_values(effect.values + sign * step)) for sign in (1.0, -1.0))
            change = (above - below)[:, :, effect.amounts] @ effect.values[effect.amounts]
            derivatives.append(change / (2.0 * step[k]))
        return np.stack(derivatives, axis=2) if derivatives else np.empty((len(self.q), 3, 0))

    def _compliance(self, effect: Effect) -> FloatArray:
        k = self.simulation.place(effect).joint
        if not self.simulation.bears_weight:
            return np.zeros((len(self.q), 3, 1))
        return self.by_joint[:, :, [k]] * self.torques[:, None, [k]]

    def _gravity_backlash(self, effect: Effect) -> FloatArray:
        k = self.simulation.place(effect).joint
        if not self.simulation.bears_weight:
            return np.zeros((len(self.q), 3, 2))
        side = flanks(self.torques[:, k], float(effect.values[1]))
        return _with_moment(self.by_joint[:, :, [k]] * 0.5 * side[:, None, None])

    def _payload(self, effect: Effect) -> FloatArray:
        springs = self.simulation.springs
        if not (springs.any() and self.simulation.bears_weight):
            return np.zeros((len(self.q), 3, len(effect.values)))
        robot = self.simulation.robot
        units = [GravityLoad.of_payload(robot, float(unit[0]), unit[1:]) for unit in np.eye(len(effect.values))]
        return np.stack([self.by_joint @ (springs * one.torques(self.q))[:, :, None] for one in units], axis=2)[..., 0]

    def _link(self, effect: Effect) -> FloatArray:
        simulation = self.simulation
        k = simulation.place(effect).joint
        turn, by_turn = rotation(effect.values)
        if simulation.upward[k]:
            # Frame after the joint's own motion, in which the link above begins.
            frame = self.frames[:, k + 1] @ inverse(self.chain.fixed[k + 1])
            axes = -frame[:, :3, :3] @ turn.T
        else:
            frame = self.frames[:, k]
            axes = frame[:, :3, :3] @ turn.T
        lever = self.x_true - frame[:, :3, 3]
        return self._seen(_moved_and_turned(axes, axes @ by_turn, lever))

    def _tool(self, effect: Effect) -> FloatArray:
        return self._seen(self.frames[:, -1, :3, :3])

    def _tool_slip(self, effect: Effect) -> FloatArray:
        return _with_moment(self._tool(effect) * self._after(effect))

    def _camera(self, effect: Effect) -> FloatArray:
        return self._optical(self._since_moved(_of_camera(effect, self.x_placed)))

    def _camera_moved(self, effect: Effect) -> FloatArray:
        return _with_moment(self._optical(_of_camera(effect, self.x_camera)) * self._after(effect))

    def _optics(self, effect: Effect) -> FloatArray:
        optics, calibration = self.simulation.optics, self.simulation.robot.calibration
        columns = []
        for parameter in effect.parameters:
            number = getattr(optics, parameter.name)
            more, less = (replace(optics, **{parameter.name: number + step}) for step in (_STEP, -_STEP))
            change = more.reported(self.x_camera, calibration) - less.reported(self.x_camera, calibration)
            columns.append(change / (2.0 * _STEP))
        return np.stack(columns, axis=2)

    def _latency(self, effect: Effect) -> FloatArray:
        # Include the encoder errors: they too are those of the earlier moment.
        latency = self.simulation.latency_s
        later, sooner = (self.simulation.unloaded(self.motion.earlier(latency + s)) for s in (_STEP_S, -_STEP_S))
        return np.einsum("nij,nj->ni", self.by_joint, (later - sooner) / (2.0 * _STEP_S))[:, :, None]

    def _drift(self, effect: Effect) -> FloatArray:
        return _with_moment(settled(self.motion, effect.values[3])[:, None, None] * np.eye(3))

    def _after(self, effect: Effect) -> FloatArray:
        return after(self.motion, effect)[:, None, None].astype(np.float64)

    def _seen(self, moved: FloatArray) -> FloatArray:
        """Return the change of the measurements by moves (n, 3, p) [m] of the point in the nominal camera's frame."""
        for effect in self.simulation.effects:
            if effect.name == "camera_pose":
                moved = rotation(effect.values)[0].T @ moved
        return self._optical(self._since_moved(moved))

    def _since_moved(self, moved: FloatArray) -> FloatArray:
        """Return moves (n, 3, p) in the present camera frame, from moves in the frame where it was set up."""
        for effect in self.simulation.effects:
            if effect.name == "camera_moved":
                moved = np.where(self._after(effect) > 0.0, rotation(effect.values)[0].T @ moved, moved)
        return moved

    def _optical(self, moved: FloatArray) -> FloatArray:
        """Return the change of the measurements by moves (n, 3, p) of the point in the camera's frame [m]."""
        optics = self.simulation.optics
        if not optics.inside:
            return moved * (1.0 + optics.scale_error)
        return np.einsum("nij,njp->nip", self._by_point, moved)

    @cached_property
    def _by_point(self) -> FloatArray:
        """Derivatives (n, 3, 3) of the reported position by the point."""
        optics, calibration = self.simulation.optics, self.simulation.robot.calibration
        changes = [
            optics.reported(self.x_camera + step, calibration) - optics.reported(self.x_camera - step, calibration)
            for step in _STEP * np.eye(3)
        ]
        return np.stack(changes, axis=2) / (2.0 * _STEP)

    _BY_NAME: ClassVar[dict[str, Callable[[Simulated, Effect], FloatArray]]] = {
        "joint_compliance": _compliance,
        "gravity_backlash": _gravity_backlash,
        "payload": _payload,
        "link_geometry": _link,
        "tool_offset": _tool,
        "tool_slip": _tool_slip,
        "camera_pose": _camera,
        "camera_moved": _camera_moved,
        "camera_scale": _optics,
        "camera_focal": _optics,
        "lens_distortion": _optics,
        "camera_latency": _latency,
        "thermal_drift": _drift,
    }


def _of_camera(effect: Effect, x: FloatArray) -> FloatArray:
    """Return moves (n, 3, 6) of points x (n, 3) in a camera's frame, by the parameters of its pose."""
    turn, by_turn = rotation(effect.values)
    axes = np.broadcast_to(-turn.T, (len(x), 3, 3))
    return _moved_and_turned(axes, axes @ by_turn, x)


def _moved_and_turned(shifts: FloatArray, axes: FloatArray, lever: FloatArray) -> FloatArray:
    """Return moves (n, 3, 6) at levers (n, 3): shifts (n, 3, 3), and turns about the columns of axes (n, 3, 3)."""
    turned = np.cross(np.swapaxes(axes, 1, 2), lever[:, None, :])
    return np.concatenate([shifts, np.swapaxes(turned, 1, 2)], axis=2)


def _with_moment(columns: FloatArray) -> FloatArray:
    """Return derivatives (n, 3, p) with zeros appended for the moment."""
    return np.concatenate([columns, np.zeros_like(columns[:, :, :1])], axis=2)
