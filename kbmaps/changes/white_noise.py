"""Noise of single pairs: the camera's measurement noise and the joints' reading errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.special import ndtr, stdtrit  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from kbmaps.arrays import FloatArray, frozen
from kbmaps.variance_components import in_typical_units, most_probable_shares


@dataclass(frozen=True, eq=False)
class WhiteNoise:
    """Variances of each pair's independent error, which it does not share with its neighbours.

    A pair's error has the covariance

        a C + b 1 + Σ_j s_j² J_j J_jᵀ

    with the claimed covariance C of the measured position, and the derivatives J_j of the position by joint j: an
    encoder's ticks move the predicted position along them, so the errors of the axes are correlated.

    Attributes:
        claimed: a, the factor by which the claimed covariance is too small; never below 1, as neighbours may share a
            camera's claimed error where the marker is partly hidden for a while.
        beside: b, the same on all axes [m²].
        joints: s_j², of the joints' readings (d,) [rad², m²].
    """

    claimed: float
    beside: float
    joints: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", frozen(self.joints))

    @classmethod
    def as_claimed(cls, joints: int) -> Self:
        """Return the noise claimed by the camera, for this number of joints."""
        return cls(1.0, 0.0, np.zeros(joints))

    @classmethod
    def of(cls, errors: FloatArray, covariances: FloatArray, derivatives: FloatArray) -> Self:
        """Estimate the noise from differences of neighbours, in which errors of the model cancel.

        Maximum likelihood variances of Gaussian differences, by the MM algorithm of Zhou, Hu, Zhou and Lange (2019, "MM
        algorithms for variance components models"). It keeps variances positive and each step increases the likelihood.
        With too few pairs, the claimed noise is returned.

        Args:
            errors: errors of a model's predictions (n, 3) [m], in the order of the pairs.
            covariances: claimed covariances of the measured positions (n, 3, 3) [m²].
            derivatives: derivatives of the positions by the joints (n, 3, d) [m/rad, or 1 for a prismatic joint].
        """
        joints = derivatives.shape[2]
        if len(errors) - 1 < _Settings.min_a_variance * (joints + 2):
            return cls.as_claimed(joints)
        off = np.diff(errors, axis=0) * np.sqrt(0.5)
        alike = np.broadcast_to(np.eye(3), (len(errors), 1, 3, 3))
        columns = derivatives.mT
        spread = np.concatenate([(columns[..., :, None] * columns[..., None, :]), covariances[:, None], alike], axis=1)
        spread = 0.5 * (spread[1:] + spread[:-1])
        spread, units = in_typical_units(spread, off)
        shares, likelihood = most_probable_shares(spread, off)
        of_camera, without_joints = most_probable_shares(spread[:, joints:], off)
        # Errors of joints that rotate in all directions resemble isotropic noise: they need evidence (Schwarz 1978).
        if likelihood - without_joints < 0.5 * joints * np.log(3.0 * len(off)):
            shares = np.concatenate([np.zeros(joints), of_camera])
        variances = shares * units
        return cls(max(float(variances[-2]), 1.0), float(variances[-1]), variances[:joints])

    def of_readings(self, derivatives: FloatArray) -> FloatArray:
        """Return the part of the joints' readings in pairs' errors (n, 3, 3) [m²]; the argument as in `of`."""
        return (derivatives * self.joints) @ derivatives.mT

    def covariances(self, covariances: FloatArray, derivatives: FloatArray) -> FloatArray:
        """Return covariances of pairs' errors (n, 3, 3) [m²]; arguments as in `of`."""
        return self.claimed * covariances + self.beside * np.eye(3) + self.of_readings(derivatives)


class _Settings:
    usually_shared: int = 10  # Default number of neighbours of a path that share a model's error: 20 degrees of it
    # Sums over longer lags than this, or than this share of the series, would be dominated by noise.
    longest_lag: int = 200
    longest_lag_share: float = 0.125
    clearly: float = 2.0  # neighbours share an error if their products are this many standard errors above 0
    # The estimated variance must hold in the tail [sigmas], where a Gaussian coordinate falls once in as many pairs as
    # lie between false alarms.
    tail_sigmas: float = 4.5
    longest_run: int = 1000  # longer runs are treated as this long
    # Lower bound: residuals of 0 determine no variance, and no model is this much better than its claim.
    least: float = 1e-12
    max_taken: float = 0.8  # a fit absorbs at most this share of the error that neighbours share
    min_a_variance: int = 10  # minimum number of pairs for each estimated variance


@dataclass(frozen=True, eq=False)
class SharedNoise:
    """Variance of whitened residuals, and of means of runs of neighbours times their length.

    Attributes:
        variances: n times the variance of the mean of n neighbours, for n = 1, 2, ... (m,); constant from there on. A
            model's error may be the same all along a walk: a change has to be larger than that, for any number of
            pairs.
        whole: the same for all pairs of a long walk, in which such errors have both signs.
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
            share: share of the variance due to the model's error.
        """
        alike = 1.0 + share * np.arange(_Settings.longest_run if share > 0.0 else 1, dtype=np.float64)
        return cls(alike, 1.0 + share * (_Settings.usually_shared - 1))

    @classmethod
    def repeated(cls, share: float) -> SharedNoise:
        """Return the noise of unit-variance residuals of which a share may repeat for some neighbours.

        A joint that moves by whole ticks from pair to pair, or hardly at all, is rounded the same way each time.

        Args:
            share: share of the variance due to that rounding.
        """
        alike = 1.0 + share * np.arange(_Settings.usually_shared, dtype=np.float64)
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
        square = max(float(np.square(residuals).mean()), _Settings.least) * 3 * n / max(3 * n - used, n)
        kept = _autocovariances(residuals, _Settings.clearly * square * math.sqrt(2.0 / (3.0 * n)))
        lengths = np.arange(1, len(kept) + 2)
        shares = np.maximum(1.0 - np.arange(1, len(kept) + 1) / lengths[:, None], 0.0)
        variances = square + 2.0 * shares @ kept
        together = np.maximum(variances / square, 1.0)
        if len(kept):
            # A shared error has fewer independent parts, of which a fit absorbs more: new pairs show more of it.
            taken = min(used * float(together[-1]) / (3.0 * n), _Settings.max_taken)
            alone = max(square - max(float(kept[0]), 0.0), 0.0)
            variances = alone + (variances - alone) / (1.0 - taken)
        variances = np.maximum.accumulate(variances * _raised(3.0 * n / together))
        whole = float(variances[-1])
        if len(kept):
            longer = np.append(variances, np.full(max(_Settings.longest_run - len(variances), 0), whole))
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
    longest = min(int(n * _Settings.longest_lag_share), _Settings.longest_lag) // 2 * 2
    lags = np.array([float(np.vdot(residuals[k:], residuals[:-k])) / (3 * (n - k)) for k in range(1, longest + 1)])
    pairs = lags.reshape(-1, 2).sum(axis=1)
    if not len(pairs) or pairs[0] <= chance:
        return np.empty(0)
    ends = np.flatnonzero(pairs <= 0.0)
    return lags[: 2 * (int(ends[0]) if len(ends) else len(pairs))]


def _raised(parts: FloatArray) -> FloatArray:
    """Return the factor that raises variances estimated from this many independent parts."""
    tail = float(ndtr(-_Settings.tail_sigmas))
    return np.square(stdtrit(np.maximum(parts, 3.0), 1.0 - tail) / _Settings.tail_sigmas)
