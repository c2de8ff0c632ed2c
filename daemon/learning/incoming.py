"""Which pairs are taken at all."""

from __future__ import annotations

import numpy as np

from interfaces.errors import RequestError
from interfaces.records import Pair

from .state import Counters

# A measurement farther away than this is not one in metres [m].
FARTHEST_M = 1000.0


def check_pair(pair: Pair, counters: Counters, joints: int) -> None:
    """RequestError when it is no pair of this robot and store, not newer than the last one, or no measurement."""
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
