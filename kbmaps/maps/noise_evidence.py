"""Noise of a linear model with a known prior, estimated by the evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray

# Variances below (1 pm)² are rounding.
VARIANCE_FLOOR = 1e-24
_ROUNDS, _POINTS = 5, 41
# Range of the search for the best variance around the mean square: below it down to float64's resolution, and above.
_LEAST_SHARE, _GREATEST_SHARE = 1e-20, 1e2


@dataclass(frozen=True, eq=False)
class LinearEvidence:
    """Log evidence of y = H β + e as a function of the variance s² of the noise e, with β ~ N(0, 1).

    With H = U diag(√γ) Vᵀ, a = Uᵀ y and y₀ the part of y that no β reaches,

        −2 log p(y) = N log(2π s²) + Σ log(1 + γ / s²) + y₀ᵀ y₀ / s² + Σ a² / (s² + γ).

    All terms are positive. Computed as a difference of yᵀ y and the part that β explains, the noise of a wide prior
    would be rounding.

    Attributes:
        count: N, the number of coordinates of y; not whole where pairs are partly forgotten.
        unreached: y₀ᵀ y₀.
        eigenvalues: γ (p,).
        along: a (p,).
    """

    count: float
    unreached: float
    eigenvalues: FloatArray
    along: FloatArray

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
        """Return the variance of the greatest evidence, found on ever finer grids of its logarithm."""
        mean = (self.unreached + float(np.square(self.along).sum())) / self.count
        if not len(self.eigenvalues):
            return max(mean, VARIANCE_FLOOR)
        middle, low, high = max(mean, VARIANCE_FLOOR), _LEAST_SHARE * mean, _GREATEST_SHARE * mean
        low, high = max(low, VARIANCE_FLOOR), max(high, VARIANCE_FLOOR)
        for _ in range(_ROUNDS):
            grid = np.geomspace(low, high, _POINTS)
            best = int(self.at(grid).argmax())
            middle = float(grid[best])
            low, high = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, _POINTS - 1)])
        return middle
