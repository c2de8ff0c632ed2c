"""Inverse kinematics: joint values for a target position or pose, on any model with a derivative."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, IntArray, frozen, limits, vector
from kbmaps.errors import SettingError, ShapeError
from kbmaps.inverse.descent import Descent, JointRange, descend, settle
from kbmaps.model import PoseModel, PositionModel
from kbmaps.rotations import rotation_matrices, rotation_vector


@dataclass(frozen=True, eq=False)
class PositionGoal:
    """Target position x (3,) [m] of the marker, to within the tolerance [m]."""

    model: PositionModel
    x: FloatArray
    tolerance: float

    def error(self, q: FloatArray) -> FloatArray:
        return self.x - self.model.predict(q)

    def jacobian(self, q: FloatArray) -> FloatArray:
        return self.model.jacobian(q)

    def reached(self, error: FloatArray) -> bool:
        return float(error @ error) <= self.tolerance**2


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """Target position x (3,) [m] of the marker with the orientation `rotation` (3, 3)."""

    model: PoseModel
    x: FloatArray
    rotation: FloatArray
    lever: float  # the length [m] at which a radian of orientation counts as much as the arc that it makes
    # tolerance, angle_tolerance: errors that count as reached [m], [rad]
    tolerance: float
    angle_tolerance: float

    def error(self, q: FloatArray) -> FloatArray:
        turn = rotation_vector(self.rotation @ self.model.orientation(q, orthonormal=True).T)
        return np.concatenate([self.x - self.model.predict(q), self.lever * turn])

    def jacobian(self, q: FloatArray) -> FloatArray:
        return np.concatenate([self.model.jacobian(q), self.lever * self.model.angular_jacobian(q)])

    def reached(self, error: FloatArray) -> bool:
        distance, angle = np.linalg.norm(error[:3]), np.linalg.norm(error[3:]) / self.lever
        return bool(distance <= self.tolerance and angle <= self.angle_tolerance)


class _Settings:
    samples: int = 4096
    starts: int = 16
    pose_starts: int = 48
    max_steps: int = 3000
    tolerance_m: float = 1e-7
    tolerance_rad: float = 1e-7
    candidates: int = 8  # starts are chosen among this many times as many samples near the target


Reason = Literal["reached", "out_of_reach", "steps_ran_out"]


@dataclass(frozen=True, eq=False)
class InverseSolution:
    """Joint values for one target, with the remaining error.

    Attributes:
        q: joint values (d,) [rad, m] within the limits: the nearest to the target of all that were found.
        x: the model's marker position there (3,) [m].
        distance: distance from x to the target [m].
        angle: angle between the orientation there and the target's [rad]; None without a target orientation.
        converged: True if distance and angle are within the tolerance.
        reason: "reached"; "out_of_reach": no start leads to the target, and from q no small move leads nearer;
            "steps_ran_out": it may be in reach.
        steps: number of derivatives evaluated.
        starts: number of initial configurations.
    """

    q: FloatArray
    x: FloatArray
    distance: float
    angle: float | None
    converged: bool
    reason: Reason
    steps: int
    starts: int


class InverseKinematics:
    """Solver for joint values that reach positions, or poses, of a model.

    Resolved motion rate control (Whitney 1969), damped (Levenberg–Marquardt), within joint limits, from several starts:
    the given configuration, then samples of the whole range that come near the target, as far apart from each other as
    possible. The same arguments give the same answer. A model that changes needs a new instance (about 10 ms at d = 7).

    Args:
        model: positions and their derivative, as every map, chain and learner of this package has them; for poses also
            the orientation (`PoseModel`): a `RigidChain` (that of a learner is `learner.chain`), or a `KBMap` that has
            it.
        lower, upper: joint limits (d,) [rad, m]. A joint without a limit (infinite) may go anywhere; its samples are
            taken from one turn.
        seed: seed of the samples.
        samples: number of samples.
        starts: maximum number of starting configurations; None: 16 for a position, 48 for a pose.
        max_steps: maximum number of steps of all starts together; each takes about one evaluation of `model.jacobian`.
        tolerance, angle_tolerance: distance [m] and angle [rad] that count as reached.

    Raises:
        SettingError: unsuitable model, lower limits above upper ones, or a setting that is not positive.
        DegenerateDataError: the model has learnt too few pairs to predict.

    Example:
        >>> import numpy as np
        >>> from kbmaps import InverseKinematics, RigidChain, learning_bases
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> kbmap = arm.to_kbmap(learning_bases([-3, -2], [3, 2]))
        >>> inverse = InverseKinematics(kbmap, lower=[-3, -2], upper=[3, 2])
        >>> inverse.solve([0.3, 0.0, 0.2]).q.round(4) + 0.0
        array([ 0.    , -1.5708])
        >>> inverse.solve([0.6, 0.0, 0.0]).reason
        'out_of_reach'
    """

    def __init__(
        self,
        model: PositionModel,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        seed: int = 0,
        samples: int = _Settings.samples,
        starts: int | None = None,
        max_steps: int = _Settings.max_steps,
        tolerance: float = _Settings.tolerance_m,
        angle_tolerance: float = _Settings.tolerance_rad,
    ) -> None:
        if min(samples, 1 if starts is None else starts, max_steps) < 1 or not min(tolerance, angle_tolerance) > 0.0:
            raise SettingError("samples, starts, max_steps and both tolerances must be greater than 0")
        _check_model(model)
        self._model = model
        low, high = (
            frozen(limits(name, values, model.joints)) for name, values in (("lower", lower), ("upper", upper))
        )
        if not (low <= high).all():
            raise SettingError(f"joint {int((low > high).argmax()) + 1}'s lower limit is above its upper one")
        # Without limits use one turn, from the existing limit or about 0.
        begin = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high - 2.0 * np.pi, -np.pi))
        end = np.where(np.isfinite(high), high, begin + 2.0 * np.pi)
        half = 0.5 * (end - begin)
        self._joints = JointRange(low, high, np.where(half > 0.0, half, 1.0))
        self._starts, self._max_steps = starts, max_steps
        self._tolerance, self._angle_tolerance = float(tolerance), float(angle_tolerance)
        self._samples = np.random.default_rng(seed).uniform(begin, end, (samples, model.joints))
        self._positions = model.predict(self._samples)
        self._features: FloatArray | None = None
        self._middle = frozen(0.5 * (begin + end))

    @property
    def middle(self) -> FloatArray:
        """Middle of each joint's range (d,): a posture that keeps away from the limits."""
        return self._middle

    @cached_property
    def lever(self) -> float:
        """Length [m] at which a radian counts as much as a metre.

        RMS distance of the reachable positions from their mean.
        """
        return max(float(np.sqrt(np.square(self._positions - self._positions.mean(axis=0)).sum(axis=1).mean())), 1e-6)

    def solve(
        self,
        x: ArrayLike,
        rotation: ArrayLike | None = None,
        *,
        start: ArrayLike | None = None,
        posture: ArrayLike | None = None,
    ) -> InverseSolution:
        """Return joint values that put the marker at x (3,) [m].

        Args:
            x: target position (3,) [m].
            rotation: target orientation: a rotation matrix (3, 3) or a unit quaternion x, y, z, w (4,).
            start: the arm's configuration (d,); tried first, so that the answer is near to it if that leads to the
                target.
            posture: preferred configuration (d,), each joint measured in its half range, as far as the target leaves a
                choice; `middle` keeps away from the limits. The answer is locally the nearest to the solution found
                first.

        Raises:
            SettingError: a rotation was given, and the model has no orientation.
        """
        goal = self._goal(vector("x", x, 3), rotation)
        first = None if start is None else vector("start", start, self._model.joints)
        target = None if posture is None else vector("posture", posture, self._model.joints)
        best, steps, tried = self._search(goal, first)
        if target is not None and goal.reached(best.error):
            before, best = best, settle(goal, best, target, self._joints, self._max_steps)
            steps += best.steps - before.steps
        return self._solution(goal, best, steps, tried)

    def _goal(self, x: FloatArray, rotation: ArrayLike | None) -> PositionGoal | PoseGoal:
        if rotation is None:
            return PositionGoal(self._model, x, self._tolerance)
        target = rotation_matrices("rotation", rotation)
        if target.shape != (3, 3):
            raise ShapeError("rotation", "(3, 3), or (4,) for a quaternion", target.shape)
        if not isinstance(self._model, PoseModel):
            raise SettingError(f"a {type(self._model).__name__} gives no orientation; ask for the position alone")
        return PoseGoal(self._model, x, target, self.lever, self._tolerance, self._angle_tolerance)

    def _search(self, goal: PositionGoal | PoseGoal, first: FloatArray | None) -> tuple[Descent, int, int]:
        """Return the best descent, the steps of all, and the number of starts tried."""
        starts = self._spread_starts(goal, first)
        best = descend(goal, next(starts), self._joints, self._max_steps)
        steps, tried = best.steps, 1
        for start in starts:
            if goal.reached(best.error) or steps >= self._max_steps:
                break
            found = descend(goal, start, self._joints, self._max_steps - steps)
            steps, tried = steps + found.steps, tried + 1
            if float(found.error @ found.error) < float(best.error @ best.error):
                best = found
        return best, steps, tried

    def _spread_starts(self, goal: PositionGoal | PoseGoal, first: FloatArray | None) -> Iterator[FloatArray]:
        """Yield `first`, then samples near the goal: the nearest, then always the one farthest from all before."""
        if first is not None:
            yield first
        near = self._samples[self._nearest(goal)]
        apart = np.full(len(near), np.inf)
        chosen = 0
        for _ in range(min(self._most_starts(goal) - (first is not None), len(near))):
            yield near[chosen]
            apart = np.minimum(apart, np.abs((near - near[chosen]) / self._joints.scale).max(axis=1))
            chosen = int(apart.argmax())

    def _most_starts(self, goal: PositionGoal | PoseGoal) -> int:
        if self._starts is not None:
            return self._starts
        return _Settings.pose_starts if isinstance(goal, PoseGoal) else _Settings.starts

    def _nearest(self, goal: PositionGoal | PoseGoal) -> IntArray:
        """Return indices of the samples nearest to the goal, in order."""
        count = min(_Settings.candidates * self._most_starts(goal), len(self._samples))
        # For some thousand points a search tree would not be faster.
        if isinstance(goal, PoseGoal):
            far = self._pose_features(goal.model) - _pose_features(goal.x, goal.rotation, goal.lever)
        else:
            far = self._positions - goal.x
        square = np.einsum("ij,ij->i", far, far)
        nearest = np.argpartition(square, count - 1)[:count]
        return nearest[np.argsort(square[nearest], kind="stable")]

    def _pose_features(self, model: PoseModel) -> FloatArray:
        """Return the samples' features; computed for the first pose."""
        if self._features is None:
            rotations = model.orientation(self._samples, orthonormal=True)
            self._features = _pose_features(self._positions, rotations, self.lever)
        return self._features

    def _solution(self, goal: PositionGoal | PoseGoal, found: Descent, steps: int, tried: int) -> InverseSolution:
        converged = goal.reached(found.error)
        everywhere = found.ended and steps < self._max_steps
        reason: Reason = "reached" if converged else "out_of_reach" if everywhere else "steps_ran_out"
        angle = float(np.linalg.norm(found.error[3:])) / goal.lever if isinstance(goal, PoseGoal) else None
        return InverseSolution(
            q=frozen(found.q),
            x=frozen(goal.x - found.error[:3]),
            distance=float(np.linalg.norm(found.error[:3])),
            angle=angle,
            converged=converged,
            reason=reason,
            steps=steps,
            starts=tried,
        )


def _check_model(model: object) -> None:
    """Raise SettingError if the model lacks an attribute of a `PositionModel`."""
    if missing := [name for name in ("joints", "predict", "jacobian") if not hasattr(model, name)]:
        raise SettingError(
            f"inverse kinematics needs a model with joints, predict and jacobian; a {type(model).__name__} has no "
            f"{', '.join(missing)}. Give a chain, a map or a learner of kbmaps, or a class of your own that has them"
        )


def _pose_features(x: FloatArray, rotations: FloatArray, lever: float) -> FloatArray:
    """Return points (..., 12) whose distances are those of poses: for small angles metres, and radians times lever."""
    turned = rotations.reshape(*x.shape[:-1], 9) * (lever / np.sqrt(2.0))
    return np.concatenate([x, turned], axis=-1)
