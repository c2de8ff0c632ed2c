"""Robust evaluation of residuals: rounding, outliers, and uncertainty from few of them."""

from __future__ import annotations

from importlib import import_module

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.pairs import Pairs

# The norm of a residual with noise σ per axis has the median 1.538 σ in three dimensions (√ of χ²₃'s median).
MEDIAN_NORM = 1.538


class RobustSettings:
    rounding_m = 1e-9  # residuals below a nanometre are rounding, even on noise-free data
    variance_floor = 1e-24  # variances [m² or rad²] below that of (1 pm)² are rounding
    # A pair this many sigma from its prediction by the others is an outlier: 3 in 100,000 good ones are farther out
    # (chi, three dimensions).
    outlier_sigmas = 4.8
    uncalibrated_sigmas = 15.0  # an arm that is not calibrated has errors with long tails, which must not be rejected
    # Where single pairs are weighed, none counts for more than one this many sigmas away: it may be an outlier.
    clipped_sigmas = 4.0


HALF_WIDTH_95 = 1.959964  # of a 95 % interval, in standard deviations of a Gaussian
_ONE_SIGMA = 0.841344746


def middle_sigma(norms: FloatArray, rank: float) -> float:
    """Return the 1-sigma of a coordinate from the middle one of residuals' norms (n,), the one of this rank.

    The rank lies above the median by the number of pairs that the fitted parameters can always explain (Rousseeuw and
    Leroy 1987, least median of squares). Otherwise a few pairs would fit perfectly and the others would count as
    outliers.
    """
    middle = min(int(rank), len(norms) - 1)
    return float(np.partition(norms, middle)[middle]) / MEDIAN_NORM


def student(freedom: float) -> float:
    """Return the factor by which a sigma with an estimated noise must be multiplied for Gaussian coverage."""
    # Imported here: it takes half a second, and not every process learns.
    from scipy.special import stdtrit  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

    return float(stdtrit(max(freedom, 1.0), _ONE_SIGMA))


def claimed_sigma(variance: FloatArray, pairs: Pairs, noise: float, freedom: float) -> FloatArray:
    """Return the 1-sigma against the truth [m] of positions with this posterior variance [m²].

    If the residuals exceed a given noise, the excess is added. If the noise was estimated from few residuals, it is
    widened, because it may be larger than estimated.

    Args:
        variance: posterior variance of each coordinate [m²].
        pairs: the fitted pairs.
        noise: noise of the fit, in the pairs' units.
        freedom: residual coordinates minus the effective number of parameters.
    """
    if pairs.known:
        return np.sqrt(variance + (noise**2 - 1.0) * float(np.square(pairs.unit).mean()))
    return np.sqrt(variance) * student(freedom)


def unexplained_variance(residuals: FloatArray, covariances: FloatArray, freedom: float) -> float:
    """Estimate the most probable isotropic variance [m²] of residuals beyond their stated covariances.

    An instrument states its own noise, which excludes that of the arm's encoders and backlash.

    Args:
        residuals: (n, 3) [m], without outliers.
        covariances: covariances of the instrument's errors (n, 3, 3) [m²].
        freedom: degrees of freedom, that is residual coordinates minus fitted parameters; above 0.
    """
    told, axes = np.linalg.eigh(covariances)
    squares = np.square((axes.swapaxes(1, 2) @ residuals[..., None])[..., 0]) * (residuals.size / freedom)

    def slope(variance: float) -> float:
        """Return twice the derivative of the log likelihood."""
        return float(((squares - told - variance) / np.square(told + variance)).sum())

    if slope(0.0) <= 0.0:
        return 0.0
    # At the largest square each term is negative. The import takes 0.2 s of CPU.
    brentq = import_module("scipy.optimize").brentq
    return float(brentq(slope, 0.0, float(squares.max()), xtol=RobustSettings.variance_floor))
