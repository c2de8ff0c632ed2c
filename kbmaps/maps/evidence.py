"""Choice of a prior's scale by the marginal likelihood of the data."""

from __future__ import annotations

import math
from collections.abc import Callable

# Multiplicative step of the search.
_STEP = math.log(8.0)
# A vertex nearer than this share of a step is not tried: evidence is flat there, and a try costs a factorisation.
_NEAR = 0.1


def most_evident(log_evidence: Callable[[float], float], start: float, low: float, high: float) -> float:
    """Return the positive scale of the greatest evidence near `start`.

    Climbs in steps of a factor until both neighbours are lower. Then tries the vertex of the parabola through the
    three, unless that is next to the middle one.

    Args:
        log_evidence: of a scale. If the search ends where it started, the best scale is the last one evaluated.
        start: first scale; clipped to the limits.
        low, high: limits of the scale.
    """
    lowest, highest = math.log(low), math.log(high)
    known: dict[float, float] = {}

    def evidence(position: float) -> float:
        if position not in known:
            known[position] = log_evidence(math.exp(position))
        return known[position]

    middle = min(max(math.log(start), lowest), highest)
    while True:
        below, above = max(middle - _STEP, lowest), min(middle + _STEP, highest)
        for position in (below, above, middle):
            evidence(position)
        best = max((middle, below, above), key=evidence)
        if best == middle:
            break
        middle = best
    if below < middle < above:
        vertex = _vertex((below, middle, above), (evidence(below), evidence(middle), evidence(above)))
        if abs(vertex - middle) > _NEAR * _STEP:
            middle = max((middle, vertex), key=evidence)
    return math.exp(middle)


def _vertex(positions: tuple[float, float, float], heights: tuple[float, float, float]) -> float:
    """Return the maximum of the parabola through three points, the middle one highest."""
    (a, b, c), (fa, fb, fc) = positions, heights
    left, right = (b - a) * (fb - fc), (b - c) * (fb - fa)
    if left == right:
        return b
    return b - 0.5 * ((b - a) * left - (b - c) * right) / (left - right)
