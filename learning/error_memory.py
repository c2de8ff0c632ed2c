"""Prequential errors: every pair is predicted before it is learnt, which measures a model's accuracy."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from bodyschema.interfaces.records import FloatArray

# Weight of the error one pair back: the memory is about 50 pairs long.
DISCOUNT = 0.98
# Below this many pairs the prior expectation counts too.
WARM = 10.0


class ErrorMemory(msgspec.Struct):
    """Discounted sums over one model's recent prediction errors.

    Attributes:
        expected_m: RMS distance expected before there were errors [m].
        weight: effective number of errors.
        square: sums of their squares per axis [m²].
        noise: sums of the measurements' variances per axis [m²].
        ratio: sum of their squares over the predicted ones.
        discount: weight of the error one pair back.
    """

    expected_m: float
    discount: float = DISCOUNT
    weight: float = 0.0
    square: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ratio: float = 0.0

    def add(self, errors: FloatArray, variances: FloatArray, ratios: FloatArray | float = 1.0) -> None:
        """Add errors, in their order.

        Args:
            errors: prediction against measurement (n, 3) [m].
            variances: the measurements', per axis (n, 3), or (3,) of all [m²].
            ratios: the errors' squares over the predicted squares of prediction and measurement (n,), or of all.
        """
        count = len(errors)
        kept, faded = self.discount**count, self.discount ** np.arange(count - 1.0, -1.0, -1.0)
        squares = np.square(errors)
        self.weight = kept * self.weight + float(faded.sum())
        self.square = _triple(kept * np.array(self.square) + faded @ squares)
        self.noise = _triple(kept * np.array(self.noise) + faded @ np.broadcast_to(variances, squares.shape))
        self.ratio = kept * self.ratio + float(faded @ np.broadcast_to(ratios, count))

    @property
    def rms_m(self) -> float:
        """RMS distance between prediction and measurement [m], shrunk to the expected one while errors are few."""
        missing = max(WARM - self.weight, 0.0)
        return math.sqrt((sum(self.square) + missing * self.expected_m**2) / max(self.weight, WARM))

    @property
    def sigma(self) -> FloatArray:
        """Uncertainty of the prediction against the truth, 1-sigma per axis (3,) [m]; noise is subtracted."""
        missing = max(WARM - self.weight, 0.0)
        square = (np.array(self.square) + missing * self.expected_m**2 / 3.0) / max(self.weight, WARM)
        noise = self.noise_variance
        return np.sqrt(np.maximum(square - noise, noise * _resolution(self.weight)))

    @property
    def noise_variance(self) -> FloatArray:
        """Mean variance of the measurements per axis (3,) [m²]."""
        return np.array(self.noise) / max(self.weight, 1.0)

    @property
    def surprise(self) -> float:
        """Ratio of the errors to the predicted ones, at least 1."""
        missing = max(WARM - self.weight, 0.0)
        return math.sqrt(max((self.ratio + missing) / max(self.weight, WARM), 1.0))


def _resolution(samples: float) -> float:
    """Return the relative standard deviation of a variance that was estimated from this many samples."""
    return math.sqrt(2.0 / max(samples, 2.0))


def _triple(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
