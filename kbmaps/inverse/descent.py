"""Descent from one configuration to the nearest one that reaches a goal: damped steps within the joint limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.inverse.reach import Goal
from kbmaps.inverse.resolved_rates import bounded_step

# The damping is this share of the error's square, times a factor adapted to the gain of the last steps.
_FIRST_SHARE, _LEAST_SHARE, _MOST_SHARE = 0.1, 1e-4, 1e6
_DAMPING_FLOOR_M2 = 1e-18
# No joint moves by more than this share of its half range in one step: the derivative does not hold farther.
_LONGEST_STEP = 0.5
# An error is stuck when its direction is this nearly perpendicular to the motion of every free joint.
_STUCK_COSINE = 1e-5
_LEAST_GAIN = 1e-4
# The descent to a posture has settled when its squared distance falls by less than this share a step.
_SETTLED = 1e-6
_LEAST_PORTION = 1e-3
_CORRECTIONS = 4


@dataclass(frozen=True, eq=False)
class JointRange:
    """Joint limits lower ≤ q ≤ upper (d,), and the half range of each joint as its scale."""

    lower: FloatArray
    upper: FloatArray
    scale: FloatArray

    def step_bounds(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        longest = _LONGEST_STEP * self.scale
        return np.maximum(self.lower - q, -longest), np.minimum(self.upper - q, longest)


@dataclass(frozen=True, eq=False)
class Descent:
    """End of a descent.

    Attributes:
        q: the configuration (d,).
        error: the remaining error there [m].
        steps: derivatives evaluated.
        ended: True if no step from there can lessen the error, or none is needed; False if the steps ran out.
    """

    q: FloatArray
    error: FloatArray
    steps: int
    ended: bool


def descend(goal: Goal, start: FloatArray, joints: JointRange, max_steps: int) -> Descent:
    """Run Levenberg–Marquardt on the error, the damping proportional to the error's square (Sugihara 2011)."""
    q = np.clip(start, joints.lower, joints.upper)
    error, share = goal.error(q), _FIRST_SHARE
    none = np.zeros(len(q))
    for step_number in range(max_steps):
        square = float(error @ error)
        if goal.reached(error):
            return Descent(q, error, step_number, True)
        jacobian = goal.jacobian(q)
        if _is_stuck(jacobian * joints.scale, error, q, joints):
            return Descent(q, error, step_number + 1, True)
        while True:
            damping = share * square + _DAMPING_FLOOR_M2
            step = bounded_step(jacobian, error, damping, joints.step_bounds(q), none, joints.scale)
            new_q = np.clip(q + step, joints.lower, joints.upper)
            new_error = goal.error(new_q)
            left = error - jacobian @ step
            expected, gained = square - float(left @ left), square - float(new_error @ new_error)
            if gained > _LEAST_GAIN * expected and gained > 0.0:
                break
            share *= 8.0
            if share > _MOST_SHARE:
                return Descent(q, error, step_number + 1, True)
        if gained > 0.75 * expected:
            share = max(share / 8.0, _LEAST_SHARE)
        elif gained < 0.25 * expected:
            share *= 2.0
        q, error = new_q, new_error
    return Descent(q, error, max_steps, goal.reached(error))


def _is_stuck(scaled_jacobian: FloatArray, error: FloatArray, q: FloatArray, joints: JointRange) -> bool:
    """Return True if all motions that could lessen the error violate the limits, or are perpendicular to it."""
    pull = scaled_jacobian.T @ error
    forbidden = ((q <= joints.lower) & (pull < 0.0)) | ((q >= joints.upper) & (pull > 0.0))
    reach = np.linalg.norm(scaled_jacobian, axis=0) * float(np.linalg.norm(error))
    return bool((forbidden | (np.abs(pull) <= _STUCK_COSINE * reach)).all())


def settle(goal: Goal, reached: Descent, posture: FloatArray, joints: JointRange, max_steps: int) -> Descent:
    """Move along the configurations that reach the goal, to the one locally nearest to `posture` in half ranges.

    Each step projects the way to the posture into the null space (Liégeois 1977), then corrects the error from
    curvature. Where that fails, or leads no nearer, half the step is tried.
    """
    q, steps, portion = reached.q, reached.steps, 1.0
    error = reached.error
    far = _square(q - posture, joints)
    while steps < max_steps and portion > _LEAST_PORTION:
        jacobian = goal.jacobian(q)
        damping = 1e-10 * float(np.square(jacobian * joints.scale).sum()) + _DAMPING_FLOOR_M2
        towards = portion * (posture - q)
        step = bounded_step(jacobian, error, damping, joints.step_bounds(q), towards, joints.scale)
        tried = descend(goal, q + step, joints, min(_CORRECTIONS, max_steps - steps))
        steps += tried.steps + 1
        new_far = _square(tried.q - posture, joints)
        if not goal.reached(tried.error) or new_far >= far:
            portion *= 0.5
            continue
        settled = far - new_far <= _SETTLED * far
        q, error, far = tried.q, tried.error, new_far
        if settled:
            return Descent(q, error, steps, True)
    return Descent(q, error, steps, portion <= _LEAST_PORTION)


def _square(way: FloatArray, joints: JointRange) -> float:
    return float(np.square(way / joints.scale).sum())
