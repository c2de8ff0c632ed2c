"""Marker positions of an arm simulated by MuJoCo: motors that follow their commands, and passive hinges that do not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from .arrays import FloatArray

STEP_S = 0.002
# A motor is so heavy that no load moves it.
MOTOR_KG_M2 = 1e8
# A passive hinge swings at no more than this [rad/s], so that a step resolves it; its rest does not depend on it.
FASTEST_RAD_S = 0.25 / STEP_S
# Damping of a hinge for each of its inertia [1/s]: it comes to rest and hardly drags the link along.
DAMPING_S = 10.0
SOLREF = (2.0 * STEP_S, 1.0)
# The hardest limits and the driest friction that MuJoCo allows.
SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
GRAVITY_M_S2 = 9.81


@dataclass(frozen=True)
class Hinge:
    """A passive hinge.

    Attributes:
        stiffness: [N·m/rad]; 0 for none.
        half_width: it turns by this much either way [rad]; None for a hinge without stops.
        friction: Coulomb friction of the hinge itself [N·m].
        bearing_friction: Coulomb friction [N·m] of the link's bearing, against the turn of motor and hinge together.
        bristle: stiffness of the bearing before it slides, Dahl's [N·m/rad]; None for friction that MuJoCo simulates.
        damped_bristle: LuGre instead of Dahl.
        inertia: of the hinge itself [kg m2]: so light that it does not drag, so heavy that its stops do not chatter.
        motor: the joint in front of it, whose turn counts in the bearing.
    """

    stiffness: float = 0.0
    half_width: float | None = None
    friction: float = 0.0
    bearing_friction: float = 0.0
    bristle: float | None = None
    damped_bristle: bool = False
    motor: str = ""
    inertia: float = 0.03


class World:
    """An arm in MuJoCo.

    Args:
        urdf: with the extension for MuJoCo.
        joints: the motors.
        hinges: passive ones by their names.
        marker_body: the link that carries the marker.
    """

    def __init__(self, urdf: str, joints: tuple[str, ...], hinges: Mapping[str, Hinge], marker_body: str) -> None:
        spec = mujoco.MjSpec.from_string(urdf)
        spec.option.timestep = STEP_S
        spec.option.gravity = [0.0, 0.0, -GRAVITY_M_S2]
        # MuJoCo scales its tolerance by the mean inertia: with motors so heavy any other one ends the solver too early.
        spec.option.tolerance = 0.0
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        for joint in spec.joints:
            joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
            joint.damping[:] = 0.0
            joint.frictionloss = 0.0
        for name, hinge in hinges.items():
            _prepare(spec, name, hinge)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        model = self._model
        self._hinges = hinges
        # Angles of the hinges at the rows of the last run that were looked at.
        self.angles: dict[str, list[float]] = {}
        self._motors = np.array([self.address(name) for name in joints])
        for address in self._motors:
            model.dof_armature[address] = MOTOR_KG_M2
        for name, hinge in hinges.items():
            address = self.address(name)
            inertia = max(hinge.inertia, hinge.stiffness / FASTEST_RAD_S**2)
            model.dof_armature[address] = inertia
            model.dof_damping[address] = DAMPING_S * hinge.inertia + 2.0 * np.sqrt(2.0 * hinge.stiffness * inertia)
        mujoco.mj_setConst(model, self._data)
        self._body = model.body(marker_body).id
        self._bristles = [
            _Bristle(hinge, self.address(hinge.motor), self.address(name))
            for name, hinge in hinges.items()
            if hinge.bristle is not None
        ]

    def loads(self, q: FloatArray) -> FloatArray:
        """Return gravity's torques [N·m] about all degrees of freedom (n, v) with the motors at q (n, d)."""
        found = []
        for row in q:
            self._rest(row)
            mujoco.mj_forward(self._model, self._data)
            found.append(-self._data.qfrc_bias.copy())
        return np.array(found)

    def address(self, joint: str) -> int:
        """Return the place of a joint among the degrees of freedom."""
        return int(self._model.jnt_dofadr[self._model.joint(joint).id])

    def poses(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return places (n, 3) [m] and orientations (n, 3, 3) of the marker's link with every hinge at its middle."""
        places, turns = [], []
        for row in q:
            self._rest(row)
            mujoco.mj_kinematics(self._model, self._data)
            self._keep(places, turns)
        return np.array(places), np.array(turns)

    def run(self, path: FloatArray, looked_at: FloatArray, settle_s: float = 1.5) -> tuple[FloatArray, FloatArray]:
        """Return places (n, 3) and orientations (n, 3, 3) of the marker's link along a path of the motors.

        Args:
            path: angles (m, d) [rad], one row a `STEP_S`.
            looked_at: increasing indices of rows (n,).
            settle_s: for how long the first row is held before.
        """
        if not self._hinges:
            return self.poses(path[looked_at])
        model, data, motors = self._model, self._data, self._motors
        mujoco.mj_resetData(model, data)
        for bristle in self._bristles:
            bristle.force = 0.0
        rates = np.vstack([np.diff(path, axis=0), np.zeros_like(path[:1])]) / STEP_S
        data.qpos[motors] = path[0]
        for _ in range(round(settle_s / STEP_S)):
            data.qpos[motors], data.qvel[motors] = path[0], 0.0
            self._step()
        self.angles = {name: [] for name in self._hinges}
        places, turns, wanted = [], [], iter([*looked_at.tolist(), -1])
        following = next(wanted)
        for row in range(len(path)):
            data.qpos[motors], data.qvel[motors] = path[row], rates[row]
            if row == following:
                mujoco.mj_kinematics(model, data)
                self._keep(places, turns)
                for name, own in self.angles.items():
                    own.append(float(data.qpos[self.address(name)]))
                following = next(wanted)
            self._step()
        return np.array(places), np.array(turns)

    def _step(self) -> None:
        for bristle in self._bristles:
            bristle.push(self._data)
        mujoco.mj_step(self._model, self._data)

    def _rest(self, row: FloatArray) -> None:
        self._data.qpos[:], self._data.qvel[:] = 0.0, 0.0
        self._data.qpos[self._motors] = row

    def _keep(self, places: list[FloatArray], turns: list[FloatArray]) -> None:
        places.append(self._data.xpos[self._body].copy())
        turns.append(self._data.xmat[self._body].reshape(3, 3).copy())


class _Bristle:
    """Dahl's or LuGre's friction of a link's bearing."""

    def __init__(self, hinge: Hinge, motor: int, give: int) -> None:
        assert hinge.bristle is not None
        self._slides_at, self._bristle = hinge.bearing_friction, hinge.bristle
        self._damped = hinge.damped_bristle
        self._motor, self._give = motor, give
        self.force = 0.0

    def push(self, data: mujoco.MjData) -> None:
        """Apply the friction of the coming step."""
        rate = float(data.qvel[self._motor] + data.qvel[self._give])
        # z' = v - |v| z / (Fc / sigma), exactly over a step at constant rate.
        length = self._slides_at / self._bristle
        kept = np.exp(-abs(rate) * STEP_S / length)
        self.force = np.sign(rate) * self._slides_at * (1.0 - kept) + self.force * kept
        damping = 0.002 * self._bristle * rate * kept if self._damped else 0.0
        data.qfrc_applied[self._give] = -self.force - damping


def _prepare(spec: mujoco.MjSpec, name: str, hinge: Hinge) -> None:
    joint = spec.joint(name)
    joint.stiffness[0] = hinge.stiffness
    joint.frictionloss = hinge.friction
    joint.solref_limit, joint.solimp_limit = SOLREF, SOLIMP
    joint.solref_friction, joint.solimp_friction = SOLREF, SOLIMP
    if hinge.half_width is not None:
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.range = [-hinge.half_width, hinge.half_width]
    if hinge.bearing_friction and hinge.bristle is None:
        tendon = spec.add_tendon(name=f"{name}_bearing", frictionloss=hinge.bearing_friction)
        tendon.solref_friction, tendon.solimp_friction = SOLREF, SOLIMP
        tendon.wrap_joint(hinge.motor, 1.0)
        tendon.wrap_joint(name, 1.0)
