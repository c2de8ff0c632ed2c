"""The virtual hand: a spring wrench at the wrist and a spring at the elbow pull the torque-free arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .bullet import Body
from .config import GuideConfig
from .geometry import turn_between
from .roles import JointRoles, chain_from_root
from .truth import TrueRobot

# Stiffness and damping follow from the arm's inertia: natural frequency [rad/s] and damping ratio of the hand's grip.
_FREQUENCY = 16.0
_DAMPING_RATIO = 0.8
# Time constant of the friction in the joints [s].
_FRICTION_TIME_S = 0.15


@dataclass(frozen=True, slots=True)
class Goals:
    """Targets of the hand, step by step.

    Attributes:
        wrist: poses of the wrist link in the world (n, 4, 4).
        elbow: places of the elbow link (n, 3) [m].
    """

    wrist: FloatArray
    elbow: FloatArray


class VirtualHand:
    """Springs that pull a body's guided joints towards a posture.

    Args:
        postures: typical postures (n, d) by reported angles; the stiffness suits the smallest inertia among them.
    """

    def __init__(
        self, body: Body, truth: TrueRobot, roles: JointRoles, config: GuideConfig, postures: FloatArray
    ) -> None:
        self._body, self._config = body, config
        self._wrist, self._elbow = roles.wrist, roles.elbow
        self._wrist_chain, self._wrist_joints = chain_from_root(truth, roles, roles.wrist)
        self._elbow_chain, self._elbow_joints = chain_from_root(truth, roles, roles.elbow)
        inertias = _Inertias(body, roles, (self._wrist, self._elbow), postures - truth.offsets)
        self._wrist_mass, self._elbow_mass = inertias.masses
        self._wrist_inertia = inertias.turning
        self.friction = inertias.joints / _FRICTION_TIME_S

    def goals(self, postures: FloatArray) -> Goals:
        """Return the hand's targets along the postures (n, d), given by reported angles."""
        return Goals(
            wrist=self._wrist_chain.poses(postures[:, self._wrist_joints]),
            elbow=self._elbow_chain.positions(postures[:, self._elbow_joints]),
        )

    def pull(self, goals: Goals, k: int) -> None:
        """Apply this step's forces towards entry `k` of the goals; their velocity is the difference to entry k - 1."""
        T, v, spin = self._body.link_motion(self._wrist)
        x_goal = goals.wrist[k, :3, 3]
        v_goal = (x_goal - goals.wrist[k - 1, :3, 3]) / self._body.dt
        self._force(self._wrist, T[:3, 3], self._spring(self._wrist_mass, x_goal - T[:3, 3], v_goal - v))
        error = turn_between(T[:3, :3], goals.wrist[k, :3, :3])
        torque = self._wrist_inertia * (_FREQUENCY**2 * error - 2 * _DAMPING_RATIO * _FREQUENCY * spin)
        self._torque(self._wrist, torque)
        T, v, _ = self._body.link_motion(self._elbow)
        v_goal = (goals.elbow[k] - goals.elbow[k - 1]) / self._body.dt
        self._force(self._elbow, T[:3, 3], self._spring(self._elbow_mass, goals.elbow[k] - T[:3, 3], v_goal - v))

    def _spring(self, mass: float, error: FloatArray, error_rate: FloatArray) -> FloatArray:
        return mass * (_FREQUENCY**2 * error + 2 * _DAMPING_RATIO * _FREQUENCY * error_rate)

    def _force(self, link: str, x: FloatArray, force: FloatArray) -> None:
        self._body.bullet.applyExternalForce(
            self._body.id,
            self._body.links[link],
            _limited(force, self._config.force_limit_n).tolist(),
            x.tolist(),
            self._body.bullet.WORLD_FRAME,
            physicsClientId=self._body.client,
        )

    def _torque(self, link: str, torque: FloatArray) -> None:
        self._body.bullet.applyExternalTorque(
            self._body.id,
            self._body.links[link],
            _limited(torque, self._config.torque_limit_nm).tolist(),
            self._body.bullet.WORLD_FRAME,
            physicsClientId=self._body.client,
        )


class _Inertias:
    """The smallest inertias that the hand feels over some postures.

    Attributes:
        masses: at each of the links [kg].
        turning: about the first of them [kg·m²].
        joints: of each joint of the body with the others held [kg·m² or kg], shape (n,).
    """

    def __init__(self, body: Body, roles: JointRoles, links: tuple[str, str], postures: FloatArray) -> None:
        columns = list(roles.guided)
        masses, turning, joints = [], [], []
        for posture in postures[:: max(1, len(postures) // 20)]:
            body.set_angles(posture)
            M = body.mass_matrix(posture)
            inverse = np.linalg.inv(M[np.ix_(columns, columns)])
            joints.append(np.diag(M))
            linear, angular = zip(*(body.jacobians(link, posture) for link in links), strict=True)
            masses.append([1 / _largest(J[:, columns] @ inverse @ J[:, columns].T) for J in linear])
            turning.append(1 / _largest(angular[0][:, columns] @ inverse @ angular[0][:, columns].T))
        self.masses = tuple(np.min(masses, axis=0))
        self.turning = float(np.min(turning))
        self.joints = np.min(joints, axis=0)


def _largest(matrix: FloatArray) -> float:
    return float(np.linalg.eigvalsh(matrix)[-1])


def _limited(vector: FloatArray, limit: float) -> FloatArray:
    length = float(np.linalg.norm(vector))
    return vector if length <= limit else vector * (limit / length)
