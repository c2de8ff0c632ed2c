"""Resolved motion rate control: joint rates for a wanted velocity, damped and within limits."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, vector
from kbmaps.errors import NonFiniteError, SettingError, ShapeError

_ROUNDING = 1e-24


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
    """Joint rates u (d,) [rad/s, m/s] that give the velocity as well as damping and limits let them.

    Without limits, u minimises ‖J u − v‖² + damping² ‖(u − preferred) / scale‖²: Whitney 1969 with the damping of
    Wampler 1986 and Nakamura and Hanafusa 1986. For little damping what J leaves free follows `preferred`. A joint
    that would pass its limit is held there, and the others make up for it as far as they can.

    Args:
        jacobian: J (m, d), m = 3 for a position [m/rad] or 6 for a pose.
        velocity: v (m,) [m/s].
        damping: greater than 0, in the units of v over those of u / scale.
        low, high: limits of the rates (d,), low ≤ high; None: without.
        preferred: rates (d,) to stay near to; None: zero.
        scale: what counts as an equally large rate of each joint (d,), greater than 0; None: 1.

    Raises:
        ShapeError, NonFiniteError, SettingError
    """
    J = np.asarray(jacobian, dtype=np.float64)
    if J.ndim != 2:
        raise ShapeError("jacobian", "(m, d)", J.shape)
    if not np.isfinite(J).all():
        raise NonFiniteError("jacobian")
    m, d = J.shape
    if not damping > 0.0:
        raise SettingError(f"damping must be greater than 0 (rates have no bound without), got {damping!r}")
    lows = np.full(d, -np.inf) if low is None else _limits("low", low, d)
    highs = np.full(d, np.inf) if high is None else _limits("high", high, d)
    if not (lows <= highs).all():
        raise SettingError("low must not be above high for any joint")
    wanted = np.zeros(d) if preferred is None else vector("preferred", preferred, d)
    scales = np.ones(d) if scale is None else vector("scale", scale, d)
    if not (scales > 0.0).all():
        raise SettingError("scale must be greater than 0 for every joint")
    # Below rounding the damping would not keep the solution finite where J loses rank.
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
    """`resolved_rates` for trusted input. Bounds as in Baerlocher and Boulic 2004: the worst joint is held, the rest
    solved anew, until none passes its bound."""
    low, high = bounds
    step = np.zeros(len(preferred))
    free = np.ones(len(preferred), dtype=np.bool_)
    ridge = damping_square * np.eye(len(wanted))
    for _ in range(len(preferred)):
        # With S = diag(scale): step = p + S² Jᵀ (J S² Jᵀ + damping²)⁻¹ (v − J p) over the joints that are free.
        scaled = jacobian * (scale * free)
        base = np.where(free, preferred, step)
        multipliers = cast(FloatArray, np.linalg.solve(scaled @ scaled.T + ridge, wanted - jacobian @ base))
        step = base + scale * (scaled.T @ multipliers)
        excess = np.maximum(low - step, step - high) / scale
        worst = int(excess.argmax())
        if excess[worst] <= 0.0:
            return step
        step[worst] = low[worst] if step[worst] < low[worst] else high[worst]
        free[worst] = False
    return np.clip(step, low, high)


def _limits(name: str, values: ArrayLike, joints: int) -> FloatArray:
    limits = np.asarray(values, dtype=np.float64)
    if limits.shape != (joints,):
        raise ShapeError(name, f"({joints},)", limits.shape)
    if np.isnan(limits).any():
        raise NonFiniteError(name)
    return limits
