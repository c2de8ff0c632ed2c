"""Resolved motion rate control: joint rates for a wanted velocity, damped and within limits."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, limits, numbers, vector
from kbmaps.errors import NonFiniteError, SettingError, ShapeError

_ROUNDING = 1e-24
_ROUNDING_SLOPE = 1e-10
_ROUNDS_A_JOINT = 6


def resolved_rates(
    jacobian: ArrayLike,
    velocity: ArrayLike,
    *,
    damping: float,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    preferred: ArrayLike | None = None,
    scale: ArrayLike | None = None,
) -> FloatArray:
    """Return joint rates u (d,) [rad/s, m/s] that give the velocity as well as damping and limits allow.

    u minimises ‖J u − v‖² + damping² ‖(u − preferred) / scale‖² within the limits: Whitney 1969 with the damping of
    Wampler 1986 and Nakamura and Hanafusa 1986. With little damping, the null space of J follows `preferred`. The other
    joints compensate as far as they can for a joint that is held at its limit.

    Args:
        jacobian: J (m, d), m = 3 for a position [m/rad] or 6 for a pose.
        velocity: v (m,) [m/s].
        damping: greater than 0, in the units of v over those of u / scale.
        low, high: limits of the rates (d,), low ≤ high; None: without.
        preferred: preferred rates (d,); None: zero.
        scale: equally large rate of each joint (d,), greater than 0; None: 1.

    Raises:
        ShapeError, NonFiniteError, SettingError

    Example:
        >>> from kbmaps import resolved_rates
        >>> resolved_rates([[0.0, 0.5]], [0.1], damping=1e-6).round(6)
        array([0. , 0.2])
    """
    J = numbers("jacobian", jacobian)
    if J.ndim != 2:
        raise ShapeError("jacobian", "(m, d)", J.shape)
    if not np.isfinite(J).all():
        raise NonFiniteError("jacobian")
    m, d = J.shape
    if not damping > 0.0:
        raise SettingError(f"damping must be greater than 0 (rates have no bound without), got {damping!r}")
    lows = np.full(d, -np.inf) if low is None else limits("low", low, d)
    highs = np.full(d, np.inf) if high is None else limits("high", high, d)
    if not (lows <= highs).all():
        raise SettingError("low must not be above high for any joint")
    wanted = np.zeros(d) if preferred is None else vector("preferred", preferred, d)
    scales = np.ones(d) if scale is None else vector("scale", scale, d)
    if not (scales > 0.0).all():
        raise SettingError("scale must be greater than 0 for every joint")
    # Below rounding, damping would not keep the solution finite where J loses rank.
    damping_square = max(damping * damping, _ROUNDING * float(np.square(J * scales).sum()), _ROUNDING)
    return bounded_step(J, vector("velocity", velocity, m), damping_square, (lows, highs), wanted, scales)


def bounded_step(
    jacobian: FloatArray,
    wanted: FloatArray,
    damping_square: float,
    bounds: tuple[FloatArray, FloatArray],
    preferred: FloatArray,
    scale: FloatArray,
) -> FloatArray:
    """Return `resolved_rates` for checked input.

    An active-set method for least squares with bounds (Stark and Parker 1995): joints are held at bounds, and released
    where that lessens the cost. The cost is strictly convex, so the method ends at the global optimum.
    """
    low, high = bounds
    free = np.ones(len(preferred), dtype=np.bool_)
    trial = _unbounded_step(jacobian, wanted, damping_square, preferred, scale, free)
    step = np.clip(trial, low, high)
    if (step == trial).all():
        return step
    free = step == trial
    for _ in range(_ROUNDS_A_JOINT * len(preferred)):
        base = np.where(free, preferred, step)
        trial = _unbounded_step(jacobian, wanted, damping_square, base, scale, free)
        inside = np.clip(trial, low, high)
        passed = free & (inside != trial)
        if passed.any():
            # As far towards the trial as the first bound.
            portions = np.where(passed, (inside - step) / np.where(passed, trial - step, 1.0), 1.0)
            first = int(portions.argmin())
            step = np.clip(step + portions[first] * (trial - step), low, high)
            step[first] = inside[first]
            free[first] = False
            continue
        step = inside
        # Half the cost's slope in the scaled joints; a held joint is released where the slope points away from its
        # bound.
        slope = damping_square * (step - preferred) / scale - scale * (jacobian.T @ (wanted - jacobian @ step))
        gain = np.where(free | (low == high), 0.0, np.where(step <= low, -slope, slope))
        best = int(gain.argmax())
        if gain[best] <= _ROUNDING_SLOPE * float(np.abs(slope).max()):
            break
        free[best] = True
    return step


def _unbounded_step(
    jacobian: FloatArray,
    wanted: FloatArray,
    damping_square: float,
    base: FloatArray,
    scale: FloatArray,
    free: BoolArray,
) -> FloatArray:
    """Return base + S² Jᵀ (J S² Jᵀ + damping²)⁻¹ (v − J base), with S = diag(scale) over the free joints."""
    scaled = jacobian * (scale * free)
    gram = scaled @ scaled.T
    np.einsum("ii->i", gram)[:] += damping_square
    return base + scale * (scaled.T @ cast(FloatArray, np.linalg.solve(gram, wanted - jacobian @ base)))
