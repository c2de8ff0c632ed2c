"""Which pairs to doubt: one gross outlier must not spoil the map, a changed tool must be followed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

# A pair this many times farther from the prediction than expected is doubted.
DOUBT = 5.0
# Median length of errors to their 1-sigma per axis, three equal axes: 1 / sqrt(2.366).
MEDIAN_TO_SIGMA = 0.6501
# No robot is that exact: distances below are never doubted for what they are [m].
SMALLEST_M = 1e-3
# So many doubted pairs in a row are no outliers: the world has changed.
CHANGE = 6
# So many are enough where one other place of the marker explains them: their distances from it are at most so many
# times what is expected, and at most this share of those from the prediction.
FEWEST_FOR_CHANGE = 3
TOGETHER = 2.0
LEFT_OVER = 0.2


class Gate:
    """Counts doubted pairs in a row."""

    def __init__(self, in_a_row: int = 0) -> None:
        self.in_a_row = in_a_row

    def doubts(self, distance_m: float, limit_m: float) -> bool:
        """Whether to doubt a pair that lies `distance_m` from its prediction."""
        doubted = distance_m > limit_m
        self.in_a_row = self.in_a_row + 1 if doubted else 0
        return doubted

    @property
    def changed(self) -> bool:
        """Whether the run of doubted pairs is a change."""
        return self.in_a_row >= CHANGE


def sound(distances_m: FloatArray, noise_m: float) -> NDArray[np.bool_]:
    """Which of a few pairs belong together, by their distances (n,) [m] from a robust fit to them, shape (n,).

    Args:
        noise_m: RMS distance between measurement and truth.
    """
    rms = math.sqrt(3.0) * MEDIAN_TO_SIGMA * float(np.median(distances_m))
    return np.asarray(distances_m <= DOUBT * max(math.hypot(rms, noise_m), SMALLEST_M))


def explained(before_m: FloatArray, after_m: FloatArray, expected_m: float) -> bool:
    """Whether an explanation takes a run of pairs from the distances `before_m` (n,) [m] to `after_m` (n,) [m]."""
    before, after = (float(np.sqrt(np.square(distances).mean())) for distances in (before_m, after_m))
    return after <= min(TOGETHER * expected_m, LEFT_OVER * before)


def limits_m(inside_m: FloatArray, open_m: FloatArray) -> FloatArray:
    """How far from their predictions pairs may lie (n,) [m].

    Args:
        inside_m: RMS distance of recent pairs from their predictions (n,).
        open_m: RMS distance that the data so far leave open where the pairs lie (n,).
    """
    return DOUBT * np.maximum(np.hypot(inside_m, open_m), SMALLEST_M)
