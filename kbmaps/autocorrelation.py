"""How much neighbours on a path share their errors."""

from __future__ import annotations

import numpy as np

from kbmaps.arrays import FloatArray

# A sum over longer lags than this share of the series would be more noise than sum.
_LONGEST_LAG_SHARE = 0.25


def shared_by(residuals: FloatArray) -> float:
    """How many neighbouring residuals tell as much as one independent one would, at least 1.

    The integrated autocorrelation time 1 + 2 Σ ρ_k of the residuals (n, 3) in their order, summed over lags for as
    long as pairs of neighbouring lags stay positive (Geyer 1992, initial positive sequence). The series is not centred:
    a mean is an error too.
    """
    n = len(residuals)
    longest = int(n * _LONGEST_LAG_SHARE)
    square = float(np.vdot(residuals, residuals)) / max(n, 1)
    if longest < 2 or square == 0.0:
        return 1.0
    # By the fast Fourier transform of the padded series (Wiener-Khinchin).
    spectrum = np.fft.rfft(residuals, 2 * n, axis=0)
    products = np.fft.irfft(np.square(np.abs(spectrum)).sum(axis=1), 2 * n)[: longest + 1]
    correlation = products / (n - np.arange(longest + 1)) / square
    pairs = correlation[: 2 * ((longest + 1) // 2)].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    count = int(ends[0]) if len(ends) else len(pairs)
    return max(2.0 * float(pairs[:count].sum()) - 1.0, 1.0)
