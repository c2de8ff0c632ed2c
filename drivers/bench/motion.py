"""Motion of emulated joints: along a given path, or each swinging on its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from bodyschema.interfaces.records import FloatArray, frozen_array

Angle = Callable[[float], float]

SLOWEST_S = 20.0  # period of the slowest swing
PHASE_RAD = 2.4  # between neighbours: the golden angle, so that no two joints move together
WIDEST_RAD = 1.0
SHARE_OF_RANGE = 0.35


def played(path: FloatArray, rate_hz: float, begin_s: float) -> list[Angle]:
    """Return for each joint a function of time that plays the path forwards and backwards forever.

    Args:
        path: angles [rad], shape (n, d) with n > 1.
        rate_hz: rows per second.
        begin_s: start time [s].
    """
    path = frozen_array(path)
    rows = np.arange(len(path), dtype=np.float64)
    last = len(path) - 1

    def joint(column: FloatArray) -> Angle:
        return lambda t: float(np.interp(last - abs((t - begin_s) * rate_hz % (2 * last) - last), rows, column))

    return [joint(np.ascontiguousarray(path[:, k])) for k in range(path.shape[1])]


def swinging(limits: Sequence[tuple[float, float]], begin_s: float) -> list[Angle]:
    """Return for each joint a slow swing around the middle of its range [rad]."""

    def joint(place: int, lower: float, upper: float) -> Angle:
        bounded = math.isfinite(lower) and math.isfinite(upper)
        middle = (lower + upper) / 2 if bounded else 0.0
        width = min(SHARE_OF_RANGE * (upper - lower), WIDEST_RAD) if bounded else WIDEST_RAD
        pace = 2 * math.pi / (SLOWEST_S * (0.6 + 0.4 / (place + 1)))
        return lambda t: middle + width * math.sin(pace * (t - begin_s) + PHASE_RAD * place)

    return [joint(place, lower, upper) for place, (lower, upper) in enumerate(limits)]
