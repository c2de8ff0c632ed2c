"""Comparison of several models by their errors on pairs that none of them had learnt."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray
from kbmaps.errors import ShapeError


class ContestSettings:
    # Over longer lags than this share of the series, the sum would be dominated by noise.
    longest_lag_share: float = 0.25
    fewest: int = 3  # minimum number of pairs predicted by both models for a comparison
    # A model whose mean error on the last so many pairs is so many times another one's does not answer: what fitted
    # most of the pairs may fail where the arm has just come to, and the cap below hides by how much. A share of 1.2 is
    # what answers are promised to stay within; fewer than 50 pairs scatter by about as much. Sensitivity, mean error on
    # 90 pairs each of two measured arms (UR5 0.158 mm, UR10 0.409 mm), a solution every ten: 0.3 to 3 times as many
    # pairs change it by up to 1 %, 0.3 to 3 times the margin above 1 by -3 to +12 %.
    recent_pairs: int = 50
    worse_ratio: float = 1.2
    min_m: float = 1e-6  # a difference too small for any camera [m]
    # A squared error is capped at this multiple of the better model's median: an outlier says nothing about either.
    cap: float = 9.0
    least: float = 1e-30  # Lower bound of the median [m²]: where a model is exact, another one that errs still loses
    # Number of the last pairs that are compared: at least this many, or this share of all so far, up to a bound.
    shortest, share, longest = 100, 0.5, 1000
    # A model is worse than another when the difference of their squared errors is this many standard errors.
    clearly: float = 2.0
    listed: int = 10  # a model is listed next to the answering one if it has predicted this many of the last pairs


def shared_by(residuals: FloatArray) -> float:
    """Return the number of neighbouring residuals, at least 1, that are worth one independent residual.

    This is the integrated autocorrelation time 1 + 2 Σ ρ_k of the residuals (n, 3) in order. The sum ends at the first
    pair of neighbouring lags that is not positive (Geyer 1992, initial positive sequence). The series is not centred: a
    mean is an error too.
    """
    n = len(residuals)
    longest = int(n * ContestSettings.longest_lag_share)
    square = float(np.vdot(residuals, residuals)) / max(n, 1)
    if longest < 2 or square == 0.0:
        return 1.0
    # Fast Fourier transform of the padded series (Wiener-Khinchin).
    spectrum = np.fft.rfft(residuals, 2 * n, axis=0)
    products = np.fft.irfft(np.square(np.abs(spectrum)).sum(axis=1), 2 * n)[: longest + 1]
    correlation = products / (n - np.arange(longest + 1)) / square
    pairs = correlation[: 2 * ((longest + 1) // 2)].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    count = int(ends[0]) if len(ends) else len(pairs)
    return max(2.0 * float(pairs[:count].sum()) - 1.0, 1.0)


@dataclass(frozen=True)
class Recent:
    """Errors on the last pairs that all of these models predicted before they learnt them.

    Attributes:
        pairs: number of pairs.
        means: by model, the mean distance between prediction and measurement [m].
    """

    pairs: int
    means: Mapping[str, float]


class PrequentialComparison:
    """Squared distances between predictions and measurements, pair by pair, for the last pairs.

    Prequential errors (Dawid 1984), compared pair by pair: two models have the same noise at the same pair, so their
    difference is more precise than their own errors.

    Args:
        errors: state to resume: by model, the squared distances (k,) [m²] of the last k pairs, NaN if missing.
        pairs: number of pairs so far.

    Raises:
        ShapeError: the models have squared distances of different numbers of pairs.
    """

    def __init__(self, errors: Mapping[str, ArrayLike] | None = None, pairs: int = 0) -> None:
        self._errors = {name: np.array(values, dtype=np.float64) for name, values in (errors or {}).items()}
        lengths = {values.shape for values in self._errors.values()} or {(0,)}
        self._length = max(lengths)[0] if len(lengths) == 1 else 0
        if lengths != {(self._length,)}:
            raise ShapeError("errors", "(k,) for each model", max(lengths))
        self._pairs = max(pairs, self._length)

    @property
    def errors(self) -> Mapping[str, FloatArray]:
        """Squared distances (k,) [m²] of the last k pairs by model, NaN if missing."""
        return self._errors

    @property
    def pairs(self) -> int:
        """Number of pairs so far."""
        return self._pairs

    def add(self, squares: Mapping[str, ArrayLike]) -> None:
        """Add a pair: the squared distance [m²] of each model that predicted it.

        Values that are not finite are ignored. Several pairs can be added in their order: the squared distances (n,) of
        each model.

        Raises:
            ShapeError: the models have squared distances of different numbers of pairs; nothing has changed.
        """
        added = {name: np.atleast_1d(np.asarray(values, dtype=np.float64)) for name, values in squares.items()}
        lengths = {values.shape for values in added.values()} or {(1,)}
        count = max(lengths)[0]
        if lengths != {(count,)}:
            raise ShapeError("squares", "(n,) for each model", max(lengths))
        for name in added:
            self._errors.setdefault(name, np.full(self._length, math.nan))
        self._pairs += count
        most = int(max(ContestSettings.shortest, ContestSettings.share * self._pairs))
        self._length = min(self._length + count, ContestSettings.longest, most)
        missing = np.full(count, math.nan)
        for name, values in self._errors.items():
            new = added.get(name, missing)
            kept = np.concatenate([values, np.where(np.isfinite(new), new, math.nan)])
            self._errors[name] = kept[-self._length :]

    def add_late(self, name: str, squares: ArrayLike) -> None:
        """Add the squared distances (n,) [m²] of a new model for the last pairs, none of which it has learnt.

        They replace those of an older model of this name. They are NaN for pairs that the model had learnt.
        """
        late = np.asarray(squares, dtype=np.float64)[-self._length :] if self._length else np.empty(0)
        values = self._errors.setdefault(name, np.full(self._length, math.nan))
        values[self._length - len(late) :] = np.where(np.isfinite(late), late, math.nan)

    def forget(self, name: str) -> None:
        """Drop the errors of a model that has been replaced."""
        self._errors.pop(name, None)

    def compares(self, name: str) -> bool:
        """Return True if a model has predicted enough of the last pairs to be compared."""
        return name in self._errors and _count(self._errors[name]) >= ContestSettings.fewest

    def recent(self, answering: str) -> Recent:
        """Return the models' errors on the last pairs, the same pairs for all of them.

        A model that has predicted few of the pairs of `answering` is left out.
        """
        last = {name: values[-ContestSettings.recent_pairs :] for name, values in self._errors.items()}
        predicted = {name: np.isfinite(values) for name, values in last.items()}
        if answering not in predicted or not predicted[answering].any():
            answering = max(predicted, key=lambda name: int(predicted[name].sum()), default="")
        if not answering:
            return Recent(0, {})
        common = predicted[answering]
        fewest = min(ContestSettings.listed, int(common.sum()))
        listed = [name for name in predicted if (predicted[name] & predicted[answering]).sum() >= fewest]
        for name in listed:
            common = common & predicted[name]
        pairs = int(common.sum())
        return Recent(pairs, {name: float(np.sqrt(last[name][common]).mean()) for name in listed} if pairs else {})

    def best(self, trusted: Sequence[str], current: str) -> str:
        """Return the model that answers: the most trusted one that no other beats.

        One beats another if the other's mean error is a fifth larger on the newest pairs of both, or if its squared
        errors are larger by more than chance on all compared pairs.

        Args:
            trusted: the models, the most trusted first.
            current: the model that answers while too few pairs were predicted.
        """
        errors = ((name, self._errors.get(name)) for name in trusted)
        candidates = {
            name: values for name, values in errors if values is not None and _count(values) >= ContestSettings.fewest
        }
        others = {name: [other for rival, other in candidates.items() if rival != name] for name in candidates}
        recent_pairs = [
            name for name in candidates if not any(_recently_worse(candidates[name], other) for other in others[name])
        ]
        for name in recent_pairs:
            if not any(_significantly_worse(candidates[name], other) for other in others[name]):
                return name
        return recent_pairs[0] if recent_pairs else current


def _count(errors: FloatArray) -> int:
    return int(np.isfinite(errors).sum())


def _recently_worse(errors: FloatArray, others: FloatArray) -> bool:
    errors, others = errors[-ContestSettings.recent_pairs :], others[-ContestSettings.recent_pairs :]
    both = np.isfinite(errors) & np.isfinite(others)
    if both.sum() < ContestSettings.fewest:
        return False
    return (
        float(np.sqrt(errors[both]).mean())
        > ContestSettings.worse_ratio * float(np.sqrt(others[both]).mean()) + ContestSettings.min_m
    )


def _significantly_worse(errors: FloatArray, others: FloatArray) -> bool:
    both = np.isfinite(errors) & np.isfinite(others)
    errors, others, count = errors[both], others[both], int(both.sum())
    if count < ContestSettings.fewest:
        return False
    cap = ContestSettings.cap * max(min(float(np.median(errors)), float(np.median(others))), ContestSettings.least)
    losses = np.minimum(errors, cap) - np.minimum(others, cap)
    mean = float(losses.mean())
    # Few losses may be similar by chance: their spread is widened accordingly.
    error = float(losses.std(ddof=1)) / math.sqrt(count) * (1.0 + 3.0 / count)
    if mean <= ContestSettings.clearly * error:
        return False
    # Neighbours on a path have correlated losses, and count as one.
    return mean > ContestSettings.clearly * error * math.sqrt(shared_by((losses - mean)[:, None]))
