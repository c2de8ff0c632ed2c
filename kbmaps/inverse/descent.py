"""Descent to a goal of inverse kinematics, by damped steps within the joint limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np

from kbmaps.arrays import BoolArray, FloatArray


class _Settings:
    # The damping is this share of the error's square, times a factor adapted to the gain of the last steps.
    first_share: float = 0.1
    min_share: float = 1e-4
    max_share: float = 1e6
    damping_floor_m2: float = 1e-18
    # No joint moves by more than this share of its half range in one step: the derivative does not hold farther.
    longest_step: float = 0.5
    # An error is stuck when its direction is this nearly perpendicular to the motion of every free joint.
    stuck_cosine: float = 1e-5
    min_gain: float = 1e-4
    # The descent to a posture has settled when its squared distance falls by less than this share a step.
    settled: float = 1e-6
    min_portion: float = 1e-3
    corrections: int = 4
    rounding_slope: float = 1e-10
    rounds_a_joint: int = 6


class Goal(Protocol):
    """Goal of inverse kinematics. Errors are in m, also those of an orientation."""

    def error(self, q: FloatArray) -> FloatArray:
        """Return the remaining error (m,) [m] at q (d,)."""
        ...

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Return the decrease of the error by a step of the joints, to first order (m, d)."""
        ...

    def reached(self, error: FloatArray) -> bool:
        """Return True if the error is within the tolerance."""
        ...


@dataclass(frozen=True, eq=False)
class JointRange:
    """Joint limits lower ≤ q ≤ upper (d,), and the half range of each joint as its scale."""

    lower: FloatArray
    upper: FloatArray
    scale: FloatArray

    def step_bounds(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        longest = _Settings.longest_step * self.scale
        return np.maximum(self.lower - q, -longest), np.minimum(self.upper - q, longest)


@dataclass(frozen=True, eq=False)
class Descent:
    """End of a descent."""

    q: FloatArray  # the configuration (d,)
    error: FloatArray  # the remaining error there [m]
    steps: int  # derivatives evaluated
    ended: bool  # True if no step from there can reduce the error, or none is needed; False if the steps ran out


def descend(goal: Goal, start: FloatArray, joints: JointRange, max_steps: int) -> Descent:
    """Run Levenberg–Marquardt on the error, the damping proportional to the error's square (Sugihara 2011)."""
    q = np.clip(start, joints.lower, joints.upper)
    error, share = goal.error(q), _Settings.first_share
    none = np.zeros(len(q))
    for step_number in range(max_steps):
        square = float(error @ error)
        if goal.reached(error):
            return Descent(q, error, step_number, True)
        jacobian = goal.jacobian(q)
        if _is_stuck(jacobian * joints.scale, error, q, joints):
            return Descent(q, error, step_number + 1, True)
        while True:
            damping = share * square + _Settings.damping_floor_m2
            step = bounded_step(jacobian, error, damping, joints.step_bounds(q), none, joints.scale)
            new_q = np.clip(q + step, joints.lower, joints.upper)
            new_error = goal.error(new_q)
            left = error - jacobian @ step
            expected, gained = square - float(left @ left), square - float(new_error @ new_error)
            if gained > _Settings.min_gain * expected and gained > 0.0:
                break
            share *= 8.0
            if share > _Settings.max_share:
                return Descent(q, error, step_number + 1, True)
        if gained > 0.75 * expected:
            share = max(share / 8.0, _Settings.min_share)
        elif gained < 0.25 * expected:
            share *= 2.0
        q, error = new_q, new_error
    return Descent(q, error, max_steps, goal.reached(error))


def _is_stuck(scaled_jacobian: FloatArray, error: FloatArray, q: FloatArray, joints: JointRange) -> bool:
    """Return True if all motions that could reduce the error violate the limits, or are perpendicular to it."""
    pull = scaled_jacobian.T @ error
    forbidden = ((q <= joints.lower) & (pull < 0.0)) | ((q >= joints.upper) & (pull > 0.0))
    reach = np.linalg.norm(scaled_jacobian, axis=0) * float(np.linalg.norm(error))
    return bool((forbidden | (np.abs(pull) <= _Settings.stuck_cosine * reach)).all())


def settle(goal: Goal, reached: Descent, posture: FloatArray, joints: JointRange, max_steps: int) -> Descent:
    """Move along the configurations that reach the goal, to the one locally nearest to `posture` in half ranges.

    Each step projects the way to the posture into the null space (Liégeois 1977), then corrects the error due to
    curvature. If that fails, or leads no nearer, half the step is tried.
    """
    q, steps, portion = reached.q, reached.steps, 1.0
    error = reached.error
    far = _square(q - posture, joints)
    while steps < max_steps and portion > _Settings.min_portion:
        jacobian = goal.jacobian(q)
        damping = 1e-10 * float(np.square(jacobian * joints.scale).sum()) + _Settings.damping_floor_m2
        towards = portion * (posture - q)
        step = bounded_step(jacobian, error, damping, joints.step_bounds(q), towards, joints.scale)
        tried = descend(goal, q + step, joints, min(_Settings.corrections, max_steps - steps))
        steps += tried.steps + 1
        new_far = _square(tried.q - posture, joints)
        if not goal.reached(tried.error) or new_far >= far:
            portion *= 0.5
            continue
        settled = far - new_far <= _Settings.settled * far
        q, error, far = tried.q, tried.error, new_far
        if settled:
            return Descent(q, error, steps, True)
    return Descent(q, error, steps, portion <= _Settings.min_portion)


def _square(step: FloatArray, joints: JointRange) -> float:
    return float(np.square(step / joints.scale).sum())


def bounded_step(
    jacobian: FloatArray,
    target: FloatArray,
    damping_square: float,
    bounds: tuple[FloatArray, FloatArray],
    preferred: FloatArray,
    scale: FloatArray,
) -> FloatArray:
    """Return the step u (d,) that minimises ‖J u − e‖² + damping² ‖(u − preferred) / scale‖² within the bounds.

    Whitney 1969 with the damping of Wampler 1986 and Nakamura and Hanafusa 1986. An active-set method for least squares
    with bounds (Stark and Parker 1995): joints are held at bounds, and released if that reduces the cost. The cost
    is strictly convex, so the method ends at the global optimum.

    Args:
        jacobian: J (m, d), m = 3 for a position [m/rad] or 6 for a pose.
        target: e (m,) [m].
        damping_square: greater than 0.
        bounds: smallest and largest step of each joint (d,).
        preferred: step (d,) that the null space of J follows.
        scale: equally large step of each joint (d,).
    """
    low, high = bounds
    free = np.ones(len(preferred), dtype=np.bool_)
    trial = _unbounded_step(jacobian, target, damping_square, preferred, scale, free)
    step = np.clip(trial, low, high)
    if (step == trial).all():
        return step
    free = step == trial
    for _ in range(_Settings.rounds_a_joint * len(preferred)):
        base = np.where(free, preferred, step)
        trial = _unbounded_step(jacobian, target, damping_square, base, scale, free)
        inside = np.clip(trial, low, high)
        passed = free & (inside != trial)
        if passed.any():
            # Go towards the trial as far as the first bound.
            portions = np.where(passed, (inside - step) / np.where(passed, trial - step, 1.0), 1.0)
            first = int(portions.argmin())
            step = np.clip(step + portions[first] * (trial - step), low, high)
            step[first] = inside[first]
            free[first] = False
            continue
        step = inside
        # Half the cost's slope in the scaled joints; a held joint is released where the slope points away from its
        # bound.
        slope = damping_square * (step - preferred) / scale - scale * (jacobian.T @ (target - jacobian @ step))
        gain = np.where(free | (low == high), 0.0, np.where(step <= low, -slope, slope))
        best = int(gain.argmax())
        if gain[best] <= _Settings.rounding_slope * float(np.abs(slope).max()):
            break
        free[best] = True
    return step


def _unbounded_step(
    jacobian: FloatArray,
    target: FloatArray,
    damping_square: float,
    base: FloatArray,
    scale: FloatArray,
    free: BoolArray,
) -> FloatArray:
    """Return base + S² Jᵀ (J S² Jᵀ + damping²)⁻¹ (v − J base), with S = diag(scale) over the free joints."""
    scaled = jacobian * (scale * free)
    gram = scaled @ scaled.T
    np.einsum("ii->i", gram)[:] += damping_square
    return base + scale * (scaled.T @ cast(FloatArray, np.linalg.solve(gram, target - jacobian @ base)))
