"""Autocorrelation of residuals along a path."""

from __future__ import annotations

import numpy as np

from kbmaps.arrays import FloatArray

# Over longer lags than this share of the series, the sum would be dominated by noise.
_LONGEST_LAG_SHARE = 0.25


def shared_by(residuals: FloatArray) -> float:
    """Return how many neighbouring residuals carry as much information as one independent residual, at least 1.

    This is the integrated autocorrelation time 1 + 2 Σ ρ_k of the residuals (n, 3) in their order. The sum ends at the
    first pair of neighbouring lags that is not positive (Geyer 1992, initial positive sequence). The series is not
    centred: a mean is an error too.
    """
    n = len(residuals)
    longest = int(n * _LONGEST_LAG_SHARE)
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
