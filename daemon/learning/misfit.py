"""What a solution misses although it knows the pairs: the arm is no such chain, or the map cannot bend like it."""

from __future__ import annotations

import math

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps.robust import OUTLIER_SIGMAS

# What is smaller than so many of its standard errors may be chance.
CLEARLY = 2.0
# Below this number of pairs, what was seen with the last tool counts.
WARM = 10.0


def misfit(
    errors: FloatArray, noise_variance: FloatArray, before: FloatArray, *, neighbours: bool, scatter: float = 0.0
) -> FloatArray:
    """1-sigma per axis (3,) [m] of what is missed, the measurements' noise left out; 0 where that may be chance.

    On a path, neighbours have the same misfit and, mostly, noise of their own: what they share is the misfit, whatever
    noise the measurements claim. Of poses far apart that claim is all there is to go by, and there the errors are too
    small by what the solution's own numbers have taken from them: it knows these pairs.

    Args:
        errors: measured minus solved (n, 3) [m], in the pairs' order.
        noise_variance: of the measurements (3,) [m²].
        before: what was missed of the same arm with another tool (3,) [m].
        neighbours: whether the pairs follow a path.
        scatter: 1-sigma of a coordinate around the solution [m], with the numbers that it has used up allowed for; 0
            where that is not known.
    """
    errors = _without_outliers(errors, scatter) if scatter > 0.0 else errors
    n = len(errors)
    if neighbours and n > 1:
        variance = (errors[1:] * errors[:-1]).mean(axis=0)
        chance = np.square(errors).mean(axis=0) / math.sqrt(n - 1)
    else:
        square = np.square(errors).mean(axis=0)
        taken = max(scatter**2 / max(float(square.mean()), 1e-300), 1.0)
        variance = taken * square - noise_variance
        chance = noise_variance * math.sqrt(2.0 * taken / n)
    seen = np.where(variance > CLEARLY * chance, variance, 0.0)
    missing = max(WARM - n, 0.0)
    return np.sqrt((n * seen + missing * np.square(before)) / max(n, WARM))


def _without_outliers(errors: FloatArray, scatter: float) -> FloatArray:
    """Those that the fit has not left out; all where these would be the fewer: then it is the fit that is off."""
    near = np.linalg.norm(errors, axis=1) <= OUTLIER_SIGMAS * scatter
    return errors[near] if near.mean() > 0.5 else errors
