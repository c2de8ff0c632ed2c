"""The virtual hand: a spring wrench at the wrist and a spring at the elbow pull the torque-free arm."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.sim_backend.geometry import turn_between

from .bullet import Body
from .config import GuideConfig
from .truth import JointRoles, TrueRobot, chain_from_root
from .visibility import Sight


class _Settings:
    # Postures of one tour. With few, the nearest is farther away, so the tour covers the joint ranges sooner.
    postures: int = 50
    batch: int = 1000
    # of a batch: a tenth holds enough where the marker is in view at most postures
    at_once: int = 100
    max_batches: int = 40
    # Share of a joint's range left free at either end.
    limit_margin: float = 0.04
    # Candidates for the next hop, and where along each the view is checked.
    candidates: int = 8
    checks: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8)
    # Spacing of the points of a hop in joint space [rad].
    spacing: float = 0.01
    # Stiffness and damping follow from the arm's inertia: natural frequency [rad/s] and damping ratio of the hand's
    # grip.
    frequency: float = 16.0
    damping_ratio: float = 0.8
    force_limit_n, torque_limit_nm = 80.0, 15.0  # strongest pull at wrist and elbow, and twist at the wrist
    # Time constant of the friction in the joints [s].
    friction_time_s: float = 0.15


class GuidePath:
    """Postures along the path, at constant speed in the joint space of all learnt joints.

    Args:
        lower, upper: joint limits (d,); guided joints stay within.
        guided: indices of the guided joints.
        step: Euclidean distance over all learnt joints, the gaze's included, between postures [rad].

    Attributes:
        waypoints: visible postures (n, d) between which the path runs; it begins at the first.

    Raises:
        ConfigError: hardly any posture has a visible ball.
    """

    def __init__(
        self,
        sight: Sight,
        lower: FloatArray,
        upper: FloatArray,
        guided: tuple[int, ...],
        step: float,
        rng: np.random.Generator,
    ) -> None:
        self._sight, self._guided, self._step, self._rng = sight, list(guided), step, rng
        margin = _Settings.limit_margin * (upper - lower)
        self._lower, self._upper = lower + margin, upper - margin
        self.waypoints = self._visible_postures()
        self._unvisited = list(range(1, len(self.waypoints)))
        self._at = self._before = self.waypoints[0]
        self._next = self._choose(self._at)
        self._remaining_length = 0.0

    def hop(self) -> FloatArray:
        """Return the postures (n, d) on the way to the next waypoint; n is 0 if it is nearer than a step."""
        start, end = self._at, self._next
        after = self._choose(end)
        curve = self._sight.gazed(np.clip(self._curve(start, end, after), self._lower, self._upper))
        self._before, self._at, self._next = start, curve[-1], after
        return self._at_even_steps(np.vstack([start, curve]))

    def replan(self, posture: FloatArray) -> None:
        """Sample new visible postures after a tool change, and continue from `posture` (d,) to the nearest."""
        self.waypoints = self._visible_postures()
        self._unvisited = list(range(len(self.waypoints)))
        self._at = self._before = posture
        self._remaining_length = 0.0
        self._next = self._choose(posture)

    def _curve(self, start: FloatArray, end: FloatArray, after: FloatArray) -> FloatArray:
        """Return a cubic from start to end with Catmull-Rom tangents, so that the path is smooth at its end."""
        leave, arrive = (end - self._before) / 2, (after - start) / 2
        count = max(2, int(np.linalg.norm((end - start)[self._guided]) / _Settings.spacing))
        s = np.linspace(0.0, 1.0, count + 1)[1:, None]
        return (
            (2 * s**3 - 3 * s**2 + 1) * start
            + (s**3 - 2 * s**2 + s) * leave
            + (3 * s**2 - 2 * s**3) * end
            + (s**3 - s**2) * arrive
        )

    def _at_even_steps(self, points: FloatArray) -> FloatArray:
        """Return postures one step apart along a polyline; the rest at its end is carried over to the next hop."""
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(lengths)])
        count = int((along[-1] + self._remaining_length) / self._step)
        wanted = self._step * np.arange(1, count + 1) - self._remaining_length
        self._remaining_length += along[-1] - self._step * count
        return np.column_stack([np.interp(wanted, along, column) for column in points.T])

    def _choose(self, start: FloatArray) -> FloatArray:
        """Return the nearest unvisited posture with a free view all along the hop, or else that with the best view."""
        if not self._unvisited:
            self.waypoints = self._visible_postures()
            self._unvisited = list(range(len(self.waypoints)))
        hops = self.waypoints[self._unvisited] - start
        nearest = np.argsort(np.linalg.norm(hops[:, self._guided], axis=1), kind="stable")[: _Settings.candidates]
        best, best_share = int(nearest[0]), -1.0
        for candidate in nearest:
            between = self._sight.gazed(start + np.array(_Settings.checks)[:, None] * hops[candidate])
            share = float(self._sight.visible(between).mean())
            if share > best_share:
                best, best_share = int(candidate), share
            if share == 1.0:
                break
        return self.waypoints[self._unvisited.pop(best)]

    def _visible_postures(self) -> FloatArray:
        """Sample postures (n, d) uniformly over the guided joints' ranges, and return those with a visible ball."""
        found: list[FloatArray] = []
        for _ in range(_Settings.max_batches):
            q = np.tile((self._lower + self._upper) / 2, (_Settings.batch, 1))
            q[:, self._guided] = self._rng.uniform(
                self._lower[self._guided], self._upper[self._guided], (_Settings.batch, len(self._guided))
            )
            for few in np.split(q, _Settings.batch // _Settings.at_once):
                few = self._sight.gazed(few)
                for posture in few[self._sight.in_images(few)]:
                    if self._sight.clear(posture):
                        found.append(posture)
                    if len(found) == _Settings.postures:
                        return np.array(found)
        if len(found) < 2:
            raise ConfigError(
                "the cameras see the marker in hardly any posture",
                remedy="Check [camera] xyz and rpy, marker_xyz and the joint limits",
            )
        return np.array(found)


class Goals(NamedTuple):
    """Targets of the hand, step by step: wrist poses in the world (n, 4, 4), and positions of the elbow (n, 3) [m]."""

    wrist: FloatArray
    elbow: FloatArray


class VirtualHand:
    """Springs that pull a body's guided joints towards a posture.

    Args:
        postures: typical postures (n, d) by reported angles, whose smallest inertia determines the stiffness.
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
        self.friction = inertias.joints / _Settings.friction_time_s

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
        torque = self._wrist_inertia * (
            _Settings.frequency**2 * error - 2 * _Settings.damping_ratio * _Settings.frequency * spin
        )
        self._torque(self._wrist, torque)
        T, v, _ = self._body.link_motion(self._elbow)
        v_goal = (goals.elbow[k] - goals.elbow[k - 1]) / self._body.dt
        self._force(self._elbow, T[:3, 3], self._spring(self._elbow_mass, goals.elbow[k] - T[:3, 3], v_goal - v))

    def _spring(self, mass: float, error: FloatArray, error_rate: FloatArray) -> FloatArray:
        return mass * (_Settings.frequency**2 * error + 2 * _Settings.damping_ratio * _Settings.frequency * error_rate)

    def _force(self, link: str, x: FloatArray, force: FloatArray) -> None:
        self._body.bullet.applyExternalForce(
            self._body.id,
            self._body.links[link],
            _limited(force, _Settings.force_limit_n).tolist(),
            x.tolist(),
            self._body.bullet.WORLD_FRAME,
            physicsClientId=self._body.client,
        )

    def _torque(self, link: str, torque: FloatArray) -> None:
        self._body.bullet.applyExternalTorque(
            self._body.id,
            self._body.links[link],
            _limited(torque, _Settings.torque_limit_nm).tolist(),
            self._body.bullet.WORLD_FRAME,
            physicsClientId=self._body.client,
        )


class _Inertias:
    """The smallest inertias that the hand feels over some postures."""

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
        self.masses = tuple(np.min(masses, axis=0))  # at each of the links [kg]
        self.turning = float(np.min(turning))  # about the first of them [kg·m²]
        self.joints = np.min(joints, axis=0)  # of each joint of the body with the others held [kg·m² or kg], shape (n,)


def _largest(matrix: FloatArray) -> float:
    return float(np.linalg.eigvalsh(matrix)[-1])


def _limited(vector: FloatArray, limit: float) -> FloatArray:
    length = float(np.linalg.norm(vector))
    return vector if length <= limit else vector * (limit / length)
