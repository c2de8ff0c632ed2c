"""Hold one run of the simulation, with derivatives by the effects' parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.urdf import inverse
from kbmaps import RigidChain

from .effect import Effect
from .flank import flanks
from .gravity import GravityLoad
from .moments import after, settled
from .motion import Motion
from .poses import rotation

if TYPE_CHECKING:
    from .simulation import Simulation

# Step of numerical derivatives by the optics' parameters and by a point.
_STEP = 1e-6
# Step by a latency [s].
_STEP_S = 1e-5
# Relative step by a period or a time constant.
_SHAPE_STEP = 1e-3


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
