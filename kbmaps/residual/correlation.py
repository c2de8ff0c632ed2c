"""Errors that neighbours on a path share: how much, and what each pair tells beyond the one before it."""

from __future__ import annotations

import math
from collections.abc import Callable

from kbmaps.arrays import FloatArray
from kbmaps.residual.evidence import PRICE

# Correlations of neighbours' errors that are tried.
CORRELATIONS = (0.0, 0.2, 0.4, 0.55, 0.65, 0.75, 0.8, 0.85, 0.88, 0.91, 0.94, 0.97)


def innovations(series: FloatArray, correlation: float) -> FloatArray:
    """A series (n, ...) whose errors are an autoregression of first order, freed of what the entry before tells.

    e_k = ρ e_{k−1} + √(1 − ρ²) fresh_k. What comes out has independent errors of the same size: Prais and Winsten 1954.
    """
    if correlation == 0.0:
        return series
    fresh = series.copy()
    fresh[1:] -= correlation * series[:-1]
    fresh[1:] /= math.sqrt(1.0 - correlation**2)
    return fresh


def most_probable(evidence: Callable[[float], float], present: float) -> float:
    """Of `CORRELATIONS`, the one of the greatest log evidence on the way uphill from the present one.

    None, unless the pairs speak for one: it has to gain as much as a group of deviations.
    """
    found: dict[int, float] = {}

    def at(place: int) -> float:
        if place not in found:
            found[place] = evidence(CORRELATIONS[place])
        return found[place]

    place, last = CORRELATIONS.index(present), len(CORRELATIONS) - 1
    while True:
        best = max((place, min(place + 1, last), max(place - 1, 0)), key=at)
        if best == place:
            return CORRELATIONS[place] if at(place) > at(0) + PRICE else 0.0
        place = best
