"""The noise of a linear model with a known prior, from the evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray

# Variances below (1 pm)² are rounding.
VARIANCE_FLOOR = 1e-24
_ROUNDS, _POINTS = 5, 41
# How far the best variance is looked for around the mean square: below it by as much as float64 can tell, and above.
_LEAST_SHARE, _GREATEST_SHARE = 1e-20, 1e2


@dataclass(frozen=True, eq=False)
class LinearEvidence:
    """Log evidence of y = H β + e as a function of the variance s² of the noise e, with β ~ N(0, 1).

    With γ the eigenvalues of Hᵀ H and c the components of Hᵀ y along its eigenvectors,

        −2 log p(y) = N log(2π s²) + Σ log(1 + γ / s²) + (yᵀ y − Σ c² / (s² + γ)) / s².

    Attributes:
        count: N, how many coordinates y has; not whole where pairs are partly forgotten.
        square: yᵀ y.
        eigenvalues, components: γ and c (p,).
    """

    count: float
    square: float
    eigenvalues: FloatArray
    components: FloatArray

    def at(self, variances: FloatArray) -> FloatArray:
        """Log evidence (m,) at variances (m,)."""
        column = variances[:, None]
        misfit = self.square - (np.square(self.components) / (column + self.eigenvalues)).sum(axis=1)
        spread = np.log1p(self.eigenvalues / column).sum(axis=1)
        return -0.5 * (self.count * np.log(2.0 * np.pi * variances) + spread + misfit / variances)

    def best_variance(self) -> float:
        """The variance of the greatest evidence, found on ever finer grids of its logarithm."""
        mean = self.square / self.count
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
