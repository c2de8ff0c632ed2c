"""How much of their noise neighbours on a path share, and how little a run of them therefore says."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray, frozen

# Errors of a model are shared by about so many neighbours of a path, where nothing is known of it: 20 degrees of it.
USUALLY_SHARED = 10
# Sums over longer lags than this, or than this share of the series, would be more noise than sum.
_LONGEST_LAG, _LONGEST_LAG_SHARE = 200, 0.125
# The noise may be larger than it seems by so many of its standard errors.
_CAREFUL = 1.5


@dataclass(frozen=True, eq=False)
class SharedNoise:
    """The variance of whitened residuals, and of means of runs of neighbours times their length.

    Attributes:
        variances: n times the variance of the mean of n neighbours, for n = 1, 2, ... (m,); constant from there on.
    """

    variances: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "variances", frozen(self.variances))

    @property
    def single(self) -> float:
        """Variance of one residual."""
        return float(self.variances[0])

    @property
    def longest(self) -> float:
        """n times the variance of the mean of n neighbours, for large n."""
        return float(self.variances[-1])

    def of_runs(self, lengths: FloatArray) -> FloatArray:
        """n times the variance of the mean of n neighbours, for these n (m,)."""
        return self.variances[np.minimum(lengths.astype(np.intp), len(self.variances)) - 1]

    @classmethod
    def claimed(cls, share: float) -> SharedNoise:
        """That of residuals of unit variance, of which this share is a model's error and so shared by neighbours."""
        lengths = np.arange(1, USUALLY_SHARED + 1)
        return cls(1.0 + share * (lengths - 1.0))

    @classmethod
    def of(cls, residuals: FloatArray, used: float = 0.0) -> SharedNoise:
        """That of residuals (n, 3), n at least 2, in their order, as large as it may well be.

        n Var(mean of n) = γ_0 + 2 Σ_{k<n} (1 − k/n) γ_k with the autocovariances γ, for as long as pairs of
        neighbouring lags stay clearly positive (Geyer 1992, initial positive sequence).

        Args:
            used: how many numbers were fitted to the residuals.
        """
        n = len(residuals)
        square = float(np.square(residuals).mean()) * 3 * n / max(3 * n - used, n)
        longest = min(int(n * _LONGEST_LAG_SHARE), _LONGEST_LAG) // 2 * 2
        lags = [float((residuals[k:] * residuals[:-k]).sum()) / (3 * (n - k)) for k in range(1, longest + 1)]
        pairs = np.array(lags).reshape(-1, 2).sum(axis=1)
        chance = square * math.sqrt(2.0 / (3.0 * n))
        ends = np.flatnonzero(pairs <= chance)
        kept = np.array(lags)[: 2 * (int(ends[0]) if len(ends) else len(pairs))]
        lengths = np.arange(1, len(kept) + 2)
        shares = np.maximum(1.0 - np.arange(1, len(kept) + 1) / lengths[:, None], 0.0)
        variances = square + 2.0 * shares @ kept
        # Where neighbours share, the series has fewer independent parts, and its variances are known less well.
        together = np.maximum(variances / square, 1.0)
        careful = 1.0 + _CAREFUL * np.sqrt(2.0 * together * (1.0 + 2.0 * len(kept) / n) / (3.0 * n))
        return cls(np.maximum.accumulate(variances * careful))

    def at_least(self, other: SharedNoise) -> SharedNoise:
        """The larger of both."""
        lengths = np.arange(1.0, max(len(self.variances), len(other.variances)) + 1)
        return SharedNoise(np.maximum(self.of_runs(lengths), other.of_runs(lengths)))

    def times(self, factor: float) -> SharedNoise:
        """With all variances multiplied."""
        return SharedNoise(factor * self.variances)
