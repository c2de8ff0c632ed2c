"""The simulation as a pipeline: encoder, structure, tool, camera, time; the nominal one with effects added.

x_measured = drift(t) + residual(q(t)) + optics(camera(tool(structure(encoder(q(t - latency))))))
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from interfaces.records import FloatArray
from interfaces.robot import RobotDescription
from interfaces.urdf import inverse
from kbmaps import RigidChain
from kbmaps.rotations import exponentials

from .effect import Effect
from .encoder import Place
from .gravity import GravityLoad
from .motion import Motion
from .optics import Optics

# A spring's deflection changes its own load: each round brings the next order.
_SPRING_ROUNDS = 3
# Effects that a rigid chain can have in it.
RIGID = ("joint_offset", "link_geometry", "tool_offset", "camera_pose")
# What an effect with a moment is after it; what is not there when nothing moves.
_STAYS = {"encoder_jump": "joint_offset", "tool_slip": "tool_offset", "camera_moved": "camera_pose"}
_OF_MOTION = ("backlash", "settling", "camera_latency", "thermal_drift")
# Of the numerical derivatives by the optics' numbers and by a point.
_STEP = 1e-6
# ... and by a latency [s].
_STEP_S = 1e-5
# ... and by a period or a time constant, as a share of it.
_SHAPE_STEP = 1e-3


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
    """

    robot: RobotDescription
    effects: tuple[Effect, ...] = ()
    residual: Residual | None = None

    @cached_property
    def gravity(self) -> GravityLoad:
        """Gravity's torques about the joints."""
        return GravityLoad(self.robot)

    def with_effects(self, effects: Sequence[Effect]) -> Simulation:
        """The same robot and residual with these effects in the place of its own."""
        changed = Simulation(self.robot, tuple(effects), self.residual)
        changed.__dict__["gravity"] = self.gravity
        return changed

    @cached_property
    def rigid(self) -> Simulation:
        """With those of its effects alone that a rigid chain can have in it, and without the residual."""
        rigid = Simulation(self.robot, tuple(effect for effect in self.effects if effect.name in RIGID))
        rigid.__dict__["gravity"] = self.gravity
        return rigid

    @property
    def since(self) -> Simulation:
        """The arm as it is since all moments of its recording have passed, standing still and cold.

        What jumped, slipped or was bumped stays where it is; what comes of motion or of warming up is not there.
        """
        own, later = [], []
        for effect in self.effects:
            if effect.name in _STAYS:
                values = effect.values[:-1]
                later.append(Effect.at(self.robot, _STAYS[effect.name], effect.where, values=values.tolist()))
            elif effect.name not in _OF_MOTION:
                own.append(effect)
        return Simulation(self.robot, (*own, *later), self.residual)

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
        return Simulation(robot.with_placement(pose, marker), effects, self.residual)

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
        for effect in self.effects:
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
        return [effect for effect in self.effects if effect.name == name]

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
        for effect in rigid.effects:
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


@dataclass(frozen=True, eq=False)
class Simulated:
    """One run of the pipeline, and how its outcome changes with each effect's numbers.

    Attributes:
        readings: what the encoders read at the time of the images.
        q: true joint angles (n, d) [rad, m].
        frames: of the joints and the marker (n, d + 1, 4, 4) in the nominal camera's frame.
        x_true, x_placed, x_camera: the marker (n, 3) [m] as the nominal camera sees it, the camera where it was set up,
            and the camera where it is.
        measured: what would be measured (n, 3) [m].
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
        """Derivative (n, 3, d) of what is measured by the true joint angles [m/rad, m/m]."""
        chain, frames = self.chain, self.frames
        axes = np.einsum("nkij,kj->nki", frames[:, :-1, :3, :3], chain.axes)
        levers = self.x_true[:, None] - frames[:, :-1, :3, 3]
        moved = np.where(chain.prismatic[:, None], axes, np.cross(axes, levers))
        return self._seen(np.swapaxes(moved, 1, 2))

    @cached_property
    def torques(self) -> FloatArray:
        """Gravity's torques (n, d) [N·m, N]."""
        return self.simulation.gravity.torques(self.q)

    @cached_property
    def wrenches(self) -> FloatArray:
        """What gravity does to all that each joint carries (n, d, 6), in the joint's frame on its parent link.

        Moments about its origin [N·m], then forces [N].
        """
        return np.concatenate(self.simulation.gravity.loads(self.q), axis=2)

    def columns(self, effect: Effect) -> FloatArray:
        """Derivative (n, 3, p) of what is measured by the effect's values, at its values; zeros for no amounts."""
        simulation = self.simulation
        if effect.kind.encoder is not None:
            place = simulation.place(effect)
            by_value = effect.kind.encoder.columns(self.readings, place, effect.values)
            return self.by_joint[:, :, [place.joint]] * by_value[:, None, :]
        return self._BY_NAME[effect.name](self, effect)

    def by_shape(self, effect: Effect) -> FloatArray:
        """Derivative (n, 3, s) of what is measured by the effect's `shapes`, at its values."""
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

    def _link(self, effect: Effect) -> FloatArray:
        simulation = self.simulation
        k = simulation.place(effect).joint
        turn, by_turn = _rotation(effect.values)
        if simulation.upward[k]:
            # The frame after the joint's own motion, in which the link above it begins.
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
        # Through the encoders' own errors: they too are those of the moment before.
        latency = self.simulation.latency_s
        later, sooner = (self.simulation.unloaded(self.motion.earlier(latency + s)) for s in (_STEP_S, -_STEP_S))
        return np.einsum("nij,nj->ni", self.by_joint, (later - sooner) / (2.0 * _STEP_S))[:, :, None]

    def _drift(self, effect: Effect) -> FloatArray:
        return _with_moment(settled(self.motion, effect.values[3])[:, None, None] * np.eye(3))

    def _after(self, effect: Effect) -> FloatArray:
        return after(self.motion, effect)[:, None, None].astype(np.float64)

    def _seen(self, moved: FloatArray) -> FloatArray:
        """What is measured of moves (n, 3, p) [m] of the point that the nominal camera sees."""
        for effect in self.simulation.effects:
            if effect.name == "camera_pose":
                moved = _rotation(effect.values)[0].T @ moved
        return self._optical(self._since_moved(moved))

    def _since_moved(self, moved: FloatArray) -> FloatArray:
        """Moves (n, 3, p) in the frame of the camera where it is, of moves in its frame where it was set up."""
        for effect in self.simulation.effects:
            if effect.name == "camera_moved":
                moved = np.where(self._after(effect) > 0.0, _rotation(effect.values)[0].T @ moved, moved)
        return moved

    def _optical(self, moved: FloatArray) -> FloatArray:
        """What is measured of moves (n, 3, p) of the point in the camera's frame [m]."""
        optics = self.simulation.optics
        if not optics.inside:
            return moved * (1.0 + optics.scale_error)
        return np.einsum("nij,njp->nip", self._by_point, moved)

    @cached_property
    def _by_point(self) -> FloatArray:
        """Derivative (n, 3, 3) of what the optics report by the point."""
        optics, calibration = self.simulation.optics, self.simulation.robot.calibration
        changes = [
            optics.reported(self.x_camera + step, calibration) - optics.reported(self.x_camera - step, calibration)
            for step in _STEP * np.eye(3)
        ]
        return np.stack(changes, axis=2) / (2.0 * _STEP)

    _BY_NAME: ClassVar[dict[str, Callable[[Simulated, Effect], FloatArray]]] = {
        "joint_compliance": _compliance,
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


def transforms(values: FloatArray) -> FloatArray:
    """Transforms (n, 4, 4) of shifts [m] and rotation vectors [rad] (n, 6)."""
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T[:, :3, :3] = exponentials(values[:, 3:6])[0]
    T[:, :3, 3] = values[:, :3]
    return T


def settled(motion: Motion, time_constant_s: float) -> FloatArray:
    """How much of a drift has come (n,), from 0 when the motion began towards 1."""
    return -np.expm1(-(motion.clock - motion.began) / time_constant_s)


def after(motion: Motion, effect: Effect) -> NDArray[np.bool_]:
    """Which rows (n,) come after the moment at which an effect begins."""
    return motion.clock >= effect.values[-1]


def _rotation(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rotation (3, 3) of a pose's values (6, ...), and by how much it turns for a change of its numbers (3, 3)."""
    turns, jacobians = exponentials(values[None, 3:6])
    return turns[0], jacobians[0]


def _of_camera(effect: Effect, x: FloatArray) -> FloatArray:
    """Moves (n, 3, 6) of points x (n, 3) in the frame of a camera, by the numbers of its pose."""
    turn, by_turn = _rotation(effect.values)
    axes = np.broadcast_to(-turn.T, (len(x), 3, 3))
    return _moved_and_turned(axes, axes @ by_turn, x)


def _moved_and_turned(shifts: FloatArray, axes: FloatArray, lever: FloatArray) -> FloatArray:
    """Moves (n, 3, 6): shifts (n, 3, 3), and turns about the columns of axes (n, 3, 3), of what is at lever (n, 3)."""
    turned = np.cross(np.swapaxes(axes, 1, 2), lever[:, None, :])
    return np.concatenate([shifts, np.swapaxes(turned, 1, 2)], axis=2)


def _with_moment(columns: FloatArray) -> FloatArray:
    """Derivatives (n, 3, p) with zeros for the number that says when."""
    return np.concatenate([columns, np.zeros_like(columns[:, :, :1])], axis=2)
