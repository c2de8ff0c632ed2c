"""Outlier gate: one gross outlier must not spoil the map, and a changed tool must be followed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.replay_memory import PairMemory


class OutlierSettings:
    times_farther = 5.0  # a pair is an outlier if it is this many times farther from the prediction than expected
    smallest_m = 1e-3  # no robot is this exact: an expected distance is never taken to be smaller [m]
    change_pairs = 6  # this many consecutive outliers prove a change
    explained_change_pairs = 3  # this many are enough if one other position of the marker explains them
    # An explanation leaves at most this multiple of the expected distance.
    explained_multiple = 2.0


MEDIAN_TO_SIGMA = 0.6501  # 1-sigma of errors per axis by their median length, three equal axes: 1 / sqrt(2.366)


class OutlierGate:
    """Counter of consecutive outliers that keeps the newest of them: they may be the first pairs of another regime.

    Isolated outliers are never learnt later, so they are not kept.
    """

    def __init__(self, joints: int) -> None:
        self._memory = PairMemory(joints, OutlierSettings.change_pairs)
        self.consecutive = 0

    @property
    def changed(self) -> bool:
        """True if the run of outliers is long enough to prove a change."""
        return self.consecutive >= OutlierSettings.change_pairs

    @property
    def possibly_changed(self) -> bool:
        """True if the run of outliers is long enough for a change, provided that one explanation fits them."""
        return self.consecutive >= OutlierSettings.explained_change_pairs

    def classify(self, q: FloatArray, x: FloatArray, distance_m: float, limit_m: float) -> bool:
        """Return True if the pair at q (d,), x (3,), `distance_m` from its prediction, is an outlier."""
        is_outlier = distance_m > limit_m
        self.consecutive = self.consecutive + 1 if is_outlier else 0
        if is_outlier:
            self._memory.append(q[None], x[None])
        else:
            self._memory.clear()
        return is_outlier

    def run(self) -> tuple[FloatArray, FloatArray]:
        """Return the newest consecutive outliers, at most the number that proves a change: q (n, d), x (n, 3)."""
        return self._memory.all()

    def restore(self, q: FloatArray, x: FloatArray, consecutive: int) -> None:
        """Resume from the run q (n, d), x (n, 3) of `consecutive` consecutive outliers."""
        self._memory.restore(q, x, consecutive)
        self.consecutive = consecutive


def inlier_mask(distances_m: FloatArray, noise_m: float) -> NDArray[np.bool_]:
    """Return the mask (n,) of those of a few pairs that fit the others, by distances [m] from a robust fit.

    Args:
        distances_m: distances (n,) [m] from the fit.
        noise_m: RMS distance between measurement and truth.
    """
    rms = math.sqrt(3.0) * MEDIAN_TO_SIGMA * float(np.median(distances_m))
    expected_m = max(math.hypot(rms, noise_m), OutlierSettings.smallest_m)
    return np.asarray(distances_m <= OutlierSettings.times_farther * expected_m)


def is_explained(before_m: FloatArray, after_m: FloatArray, expected_m: float) -> bool:
    """Return True if reducing a run's distances from `before_m` (n,) [m] to `after_m` (n,) [m] is enough."""
    before, after = (float(np.sqrt(np.square(distances).mean())) for distances in (before_m, after_m))
    return after <= min(OutlierSettings.explained_multiple * expected_m, before / OutlierSettings.times_farther)


def limits_m(inside_m: FloatArray, open_m: FloatArray) -> FloatArray:
    """Return the distances from their predictions beyond which pairs are outliers (n,) [m].

    Args:
        inside_m: RMS distance of recent pairs from their predictions (n,).
        open_m: RMS uncertainty of the predictions at the pairs' poses, due to undetermined parameters (n,).
    """
    return OutlierSettings.times_farther * np.maximum(np.hypot(inside_m, open_m), OutlierSettings.smallest_m)
