"""Choice of a prior's scale by the marginal likelihood of the data."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.robust import RobustSettings


class _Settings:
    """Settings of the search for the most evident variance.

    Sensitivity: each at 0.3 and 3 times changes error and sigma of a bent arm's models at 150 pairs by less than 1 %,
    but for `step` by 6 %.
    """

    rounds: int = 5
    points: int = 41
    # Range of the search for the best variance around the mean square: below it down to float64's resolution, and
    # above.
    min_share: float = 1e-20
    greatest_share: float = 1e2
    step: float = math.log(8.0)  # multiplicative step of the search
    # A vertex nearer than this share of a step is not tried: evidence is flat there, and a try costs a factorisation.
    near: float = 0.1


@dataclass(frozen=True, eq=False)
class LinearEvidence:
    """Log evidence of y = H β + e as a function of the variance s² of the noise e, with β ~ N(0, 1).

    With H = U diag(√γ) Vᵀ, a = Uᵀ y and y₀ the part of y that no β reaches,

        −2 log p(y) = N log(2π s²) + Σ log(1 + γ / s²) + y₀ᵀ y₀ / s² + Σ a² / (s² + γ).

    All terms are positive. If the noise of a wide prior were computed as the difference of yᵀ y and the part that β
    explains, it would be lost in rounding.
    """

    count: float  # N, the number of coordinates of y; not whole where pairs are partly forgotten
    unreached: float  # y₀ᵀ y₀
    eigenvalues: FloatArray  # γ (p,)
    along: FloatArray  # a (p,)

    def mean(self, variance: float) -> FloatArray:
        """Return the posterior mean of Vᵀ β (p,) at this s²."""
        return np.sqrt(self.eigenvalues) * self.along / (variance + self.eigenvalues)

    def at(self, variances: FloatArray) -> FloatArray:
        """Return the log evidence (m,) at variances (m,)."""
        column = variances[:, None]
        misfit = self.unreached / variances + (np.square(self.along) / (column + self.eigenvalues)).sum(axis=1)
        spread = np.log1p(self.eigenvalues / column).sum(axis=1)
        return -0.5 * (self.count * np.log(2.0 * np.pi * variances) + spread + misfit)

    def best_variance(self) -> float:
        """Return the variance of the greatest evidence, found on successively finer grids of its logarithm."""
        mean = (self.unreached + float(np.square(self.along).sum())) / self.count
        if not len(self.eigenvalues):
            return max(mean, RobustSettings.variance_floor)
        tried = mean, _Settings.min_share * mean, _Settings.greatest_share * mean
        middle, low, high = (max(variance, RobustSettings.variance_floor) for variance in tried)
        for _ in range(_Settings.rounds):
            grid = np.geomspace(low, high, _Settings.points)
            best = int(self.at(grid).argmax())
            middle = float(grid[best])
            low, high = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, _Settings.points - 1)])
        return middle


def most_evident(log_evidence: Callable[[float], float], start: float, low: float, high: float) -> float:
    """Return the positive scale of the greatest evidence near `start`.

    Climbs in steps of a factor until both neighbours are lower. Then tries the vertex of the parabola through the
    three, unless that is next to the middle one.

    Args:
        log_evidence: log evidence of a scale. If the search ends where it started, the best scale is the last one
            evaluated.
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
        below, above = max(middle - _Settings.step, lowest), min(middle + _Settings.step, highest)
        for position in (below, above, middle):
            evidence(position)
        best = max((middle, below, above), key=evidence)
        if best == middle:
            break
        middle = best
    if below < middle < above:
        vertex = _vertex((below, middle, above), (evidence(below), evidence(middle), evidence(above)))
        if abs(vertex - middle) > _Settings.near * _Settings.step:
            middle = max((middle, vertex), key=evidence)
    return math.exp(middle)


def _vertex(positions: tuple[float, float, float], heights: tuple[float, float, float]) -> float:
    """Return the maximum of the parabola through three points, the middle one highest."""
    (a, b, c), (fa, fb, fc) = positions, heights
    left, right = (b - a) * (fb - fc), (b - c) * (fb - fa)
    if left == right:
        return b
    return b - 0.5 * ((b - a) * left - (b - c) * right) / (left - right)
