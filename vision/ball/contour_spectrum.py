"""Estimate the centre's error from the residuals round an outline, decomposed into waves.

Neighbouring points of an outline share pixels and background, so their variance alone would underestimate the error. A
shift of the centre is the wave with one period round the outline. The fit has removed it, so its size is estimated from
the next slowest waves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from bodyschema.interfaces.records import FloatArray, frozen_array

from .settings import ContourSettings as _Settings


@dataclass(frozen=True, slots=True)
class ContourSpectrum:
    """Variances per point, in the square of the residuals' unit."""

    slow: float  # in the slowest waves that the fit left in
    quick: float  # in those that are quicker
    count: float  # effective number of slow waves

    @property
    def mean(self) -> float:
        """Mean of the slow and the quick waves' power, for noise that is equal in both."""
        return 0.5 * (self.slow + self.quick)

    def once_round_variance(self) -> float:
        """Variance in the wave with one period round the outline.

        Pixel noise gives all waves the same power. The background of the ball disturbs whole arcs and makes the slow
        waves larger, so their excess over the quick ones counts twice.
        """
        # Student's t with two degrees of freedom per wave: 1-sigma of an estimated spread.
        return (1.0 + 0.25 / self.count) ** 2 * (self.slow + max(0.0, self.slow - self.quick))


def residual_spectrum(residual: FloatArray, radius_px: float) -> ContourSpectrum:
    """Return the waves in the residuals (n,) of an outline's points, evenly spread around it; 0 if there are none."""
    first = 2  # the fit of a circle removes the slower ones
    quickest = len(residual) // 2
    last_slow = min(max(first + _Settings.min_waves - 1, round(radius_px / _Settings.wave_radius_px)), quickest - 1)
    last_quick = min(max(last_slow + 1, min(2 * last_slow, round(radius_px))), quickest)
    squares, share, count = _band(first, last_slow, last_quick)
    parts = np.fft.rfft(residual)[first : last_quick + 1]
    power = (
        np.square(np.abs(parts))
        * np.exp(squares * (_Settings.smoothing_px / radius_px) ** 2)
        / np.count_nonzero(residual)
    )
    return ContourSpectrum(float(share @ power[: len(share)]), float(power[len(share) :].mean()), count)


@lru_cache
def _band(first: int, last_slow: int, last_quick: int) -> tuple[FloatArray, FloatArray, float]:
    """Return the squares of all wave numbers, the slow ones' weights in their mean, and their effective number."""
    squares = np.arange(first, last_quick + 1, dtype=np.float64) ** 2
    weight = 1.0 / squares[: last_slow - first + 1]
    share = weight / weight.sum()
    return frozen_array(squares), frozen_array(share), 1.0 / float(share @ share)
