"""Noise that neighbours on a path share, and the variance of means of runs of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, stdtrit  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from kbmaps.arrays import FloatArray, frozen


@dataclass(frozen=True)
class _Settings:
    """Settings of the estimate of shared noise."""

    # Default number of neighbours of a path that share a model's error: 20 degrees of it.
    usually_shared: int = 10
    # Sums over longer lags than this, or than this share of the series, would be dominated by noise.
    longest_lag: int = 200
    longest_lag_share: float = 0.125
    # Neighbours share an error if their products are this many standard errors above 0.
    clearly: float = 2.0
    # The estimated variance must hold in the tail [sigmas], where a Gaussian coordinate falls once in as many pairs as
    # lie between false alarms.
    tail_sigmas: float = 4.5
    # Longer runs are treated as this long.
    longest_run: int = 1000
    # Lower bound: residuals of 0 determine no variance, and no model is this much better than its claim.
    least: float = 1e-12
    # A fit absorbs at most this share of the error that neighbours share.
    most_taken: float = 0.8


_SETTINGS = _Settings()


@dataclass(frozen=True, eq=False)
class SharedNoise:
    """Variance of whitened residuals, and of means of runs of neighbours times their length.

    Attributes:
        variances: n times the variance of the mean of n neighbours, for n = 1, 2, ... (m,); constant from there on. A
            model's error may be the same all along a walk: a change has to be larger than that, however many pairs
            show it.
        whole: the same for all pairs of a long walk, where such errors have both signs.
    """

    variances: FloatArray
    whole: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "variances", frozen(self.variances))

    @property
    def single(self) -> float:
        """Variance of one residual."""
        return float(self.variances[0])

    def of_runs(self, lengths: FloatArray) -> FloatArray:
        """Return n times the variance of the mean of n neighbours, for these n (m,)."""
        return self.variances[np.minimum(lengths.astype(np.intp), len(self.variances)) - 1]

    @classmethod
    def claimed(cls, share: float) -> SharedNoise:
        """Return the noise of unit-variance residuals that share a model's error with their neighbours.

        Args:
            share: of the variance, due to the model's error.
        """
        alike = 1.0 + share * np.arange(_SETTINGS.longest_run if share > 0.0 else 1, dtype=np.float64)
        return cls(alike, 1.0 + share * (_SETTINGS.usually_shared - 1))

    @classmethod
    def repeated(cls, share: float) -> SharedNoise:
        """Return the noise of unit-variance residuals of which a share may repeat for some neighbours.

        A joint that turns by whole ticks from pair to pair, or hardly at all, is rounded in the same way each time.

        Args:
            share: of the variance, due to that rounding.
        """
        alike = 1.0 + share * np.arange(_SETTINGS.usually_shared, dtype=np.float64)
        return cls(alike, float(alike[-1]))

    @classmethod
    def of(cls, residuals: FloatArray, used: float = 0.0) -> SharedNoise:
        """Estimate the noise of residuals (n, 3), n at least 2, in their order; an upper estimate.

        n Var(mean of n) = γ_0 + 2 Σ_{k<n} (1 − k/n) γ_k with the autocovariances γ, for as long as pairs of
        neighbouring lags stay positive (Geyer 1992, initial positive sequence). With a variance estimated from ν
        independent parts, a Gaussian becomes a Student variable, which has heavier tails: the variances are raised to
        match.

        Args:
            residuals: (n, 3).
            used: number of parameters fitted to the residuals.
        """
        n = len(residuals)
        square = max(float(np.square(residuals).mean()), _SETTINGS.least) * 3 * n / max(3 * n - used, n)
        kept = _autocovariances(residuals, _SETTINGS.clearly * square * math.sqrt(2.0 / (3.0 * n)))
        lengths = np.arange(1, len(kept) + 2)
        shares = np.maximum(1.0 - np.arange(1, len(kept) + 1) / lengths[:, None], 0.0)
        variances = square + 2.0 * shares @ kept
        together = np.maximum(variances / square, 1.0)
        if len(kept):
            # A shared error has fewer independent parts, of which a fit absorbs more: new pairs show more of it.
            taken = min(used * float(together[-1]) / (3.0 * n), _SETTINGS.most_taken)
            alone = max(square - max(float(kept[0]), 0.0), 0.0)
            variances = alone + (variances - alone) / (1.0 - taken)
        variances = np.maximum.accumulate(variances * _raised(3.0 * n / together))
        whole = float(variances[-1])
        if len(kept):
            longer = np.append(variances, np.full(max(_SETTINGS.longest_run - len(variances), 0), whole))
            variances = np.maximum(longer, square + max(float(kept[0]), 0.0) * np.arange(len(longer)))
        return cls(variances, whole)

    def at_least(self, other: SharedNoise) -> SharedNoise:
        """Return the larger of both."""
        lengths = np.arange(1.0, max(len(self.variances), len(other.variances)) + 1)
        variances = np.maximum(self.of_runs(lengths), other.of_runs(lengths))
        return SharedNoise(variances, max(self.whole, other.whole))

    def times(self, factor: float) -> SharedNoise:
        """Return the noise with all variances multiplied."""
        return SharedNoise(factor * self.variances, factor * self.whole)


def _autocovariances(residuals: FloatArray, chance: float) -> FloatArray:
    """Return autocovariances of residuals (n, 3) at lags 1, 2, ... while neighbours clearly share an error.

    May be empty.
    """
    n = len(residuals)
    longest = min(int(n * _SETTINGS.longest_lag_share), _SETTINGS.longest_lag) // 2 * 2
    lags = np.array([float(np.vdot(residuals[k:], residuals[:-k])) / (3 * (n - k)) for k in range(1, longest + 1)])
    pairs = lags.reshape(-1, 2).sum(axis=1)
    if not len(pairs) or pairs[0] <= chance:
        return np.empty(0)
    ends = np.flatnonzero(pairs <= 0.0)
    return lags[: 2 * (int(ends[0]) if len(ends) else len(pairs))]


def _raised(parts: FloatArray) -> FloatArray:
    """Return the factor that raises variances estimated from this many independent parts."""
    tail = float(ndtr(-_SETTINGS.tail_sigmas))
    return np.square(stdtrit(np.maximum(parts, 3.0), 1.0 - tail) / _SETTINGS.tail_sigmas)
