"""Model discrepancy: errors of a solution at pairs that it knows, because the arm or the map is of another form."""

from __future__ import annotations

import math

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps.robust import OUTLIER_SIGMAS

# A discrepancy below this many standard errors may be chance.
CLEARLY = 2.0
# Below this number of pairs, the discrepancy with the last tool counts too.
WARM = 10.0


def model_discrepancy(
    errors: FloatArray, noise_variance: FloatArray, before: FloatArray, *, neighbours: bool, scatter: float = 0.0
) -> FloatArray:
    """Return the model discrepancy, 1-sigma per axis (3,) [m], without the measurements' noise; 0 if due to chance.

    On a path, neighbours have the same discrepancy and, mostly, noise of their own: the shared part is the discrepancy,
    whatever noise the measurements claim. For poses far apart, only the claimed noise is available. There the errors
    are too small, because the solution was fitted to these pairs.

    Args:
        errors: measured minus solved (n, 3) [m], in the pairs' order.
        noise_variance: of the measurements (3,) [m²].
        before: discrepancy of the same arm with another tool (3,) [m].
        neighbours: True if the pairs follow a path.
        scatter: 1-sigma of a coordinate around the solution [m], corrected for its degrees of freedom; 0 if unknown.
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
    """Return the errors that the fit has not left out; all if these are the minority: then the fit is off."""
    near = np.linalg.norm(errors, axis=1) <= OUTLIER_SIGMAS * scatter
    return errors[near] if near.mean() > 0.5 else errors
