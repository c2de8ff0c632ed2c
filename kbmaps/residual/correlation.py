"""Correlation of errors between neighbours on a path, and the independent part of each pair."""

from __future__ import annotations

import math
from collections.abc import Callable

from kbmaps.arrays import FloatArray
from kbmaps.residual.evidence import PRICE

# Candidate correlations of neighbours' errors.
CORRELATIONS = (0.0, 0.2, 0.4, 0.55, 0.65, 0.75, 0.8, 0.85, 0.88, 0.91, 0.94, 0.97)


def innovations(series: FloatArray, correlation: float) -> FloatArray:
    """Return a series (n, ...) with first-order autoregressive errors, freed of the correlation with the entry before.

    e_k = ρ e_{k−1} + √(1 − ρ²) fresh_k. The result has independent errors of the same size: Prais and Winsten 1954.
    """
    if correlation == 0.0:
        return series
    fresh = series.copy()
    fresh[1:] -= correlation * series[:-1]
    fresh[1:] /= math.sqrt(1.0 - correlation**2)
    return fresh


def most_probable(evidence: Callable[[float], float], present: float) -> float:
    """Return the correlation of the greatest log evidence in `CORRELATIONS`, climbing from the current one.

    Returns 0 unless the pairs support one: it has to gain as much evidence as a group of deviations.
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
