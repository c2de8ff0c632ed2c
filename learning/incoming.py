"""Validation of incoming pairs."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.records import FARTHEST_M, LARGEST_Q, Pair
from bodyschema.learning.state import Counters

# As a share of a covariance's largest eigenvalue: rounding may push the smallest this far below zero.
ROUNDING = 1e-6


def check_pair(pair: Pair, counters: Counters, joints: int) -> None:
    """Raise RequestError if a pair is of another robot or store, not new, or not a measurement."""
    if counters.store not in (None, pair.store):
        raise RequestError(
            f"pair {pair.seq} comes from the store {pair.store}, this learner learnt from {counters.store}"
        )
    if pair.seq <= counters.last_seq:
        raise RequestError(f"pair {pair.seq} has been learnt already; the last one was {counters.last_seq}")
    if len(pair.q) != joints:
        raise RequestError(f"pair {pair.seq} has {len(pair.q)} joint angles, this robot has {joints}")
    if not all(np.isfinite(part).all() for part in (pair.q, pair.x, pair.cov)):
        raise RequestError(f"pair {pair.seq} has a number that is not finite")
    if np.abs(pair.x).max() > FARTHEST_M:
        raise RequestError(f"pair {pair.seq} lies {np.abs(pair.x).max():.0f} m away; positions are in metres")
    if np.abs(pair.q).max() > LARGEST_Q:
        raise RequestError(f"pair {pair.seq} has the joint angle {np.abs(pair.q).max():.3g}; angles are in radians")
    if np.abs(pair.cov).max() > FARTHEST_M**2:
        raise RequestError(f"pair {pair.seq} says that it may be {np.sqrt(np.abs(pair.cov).max()):.3g} m wrong")
    spread = np.linalg.eigvalsh(pair.cov)
    if spread[0] < -ROUNDING * max(spread[-1], 0.0):
        raise RequestError(f"pair {pair.seq} has a cov that is no covariance: a variance of {spread[0]:.3g} m²")
