"""Quantiles that tests compare counts and statistics with. `scipy.stats` has them too, and takes a second to import."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, betaincinv, chdtri, smirnov


def successes(quantile: float, tries: int, rate: float) -> int:
    """Return the least number of successes that at least this share of series stays within."""
    return int(np.argmax(bdtr(np.arange(tries + 1.0), tries, rate) >= quantile))


def highest_rate(successes: int, tries: int) -> float:
    """Return the upper end of the exact 95 % interval of a rate (Clopper and Pearson)."""
    return float(betaincinv(successes + 1.0, tries - successes, 0.975))


def chi_square(quantile: ArrayLike, freedom: int) -> NDArray[np.float64]:
    """Return quantiles of chi-square."""
    return chdtri(freedom, 1.0 - np.asarray(quantile))


def uniform_p_value(values: ArrayLike) -> float:
    """Return the p-value of the two-sided Kolmogorov-Smirnov test for values uniform in 0...1, accurate where small."""
    ordered = np.sort(values)
    steps = np.arange(len(ordered) + 1.0) / len(ordered)
    distance = max((steps[1:] - ordered).max(), (ordered - steps[:-1]).max())
    return min(2.0 * float(smirnov(len(ordered), distance)), 1.0)
