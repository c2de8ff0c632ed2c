"""On which joints an error without a name depends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from effects import Simulated
from interfaces.records import FloatArray

from .families import Family

# From this share of its variance on an error depends on a joint.
_SHOWS = 0.05
# What goes farther beyond all that was seen than this share of its range is not judged.
_BEYOND = 0.1
_SEED = 0


def joints_of(family: Family, numbers: FloatArray, run: Simulated) -> frozenset[int]:
    """The joints that err or on which the error depends, by their places in q.

    An error depends on a joint that holds a share of its variance, the others given: half the mean square change when
    this joint alone is taken from another row (Jansen 1999).

    Args:
        numbers: of the family (p,).
    """
    if family.over_time:
        return frozenset(family.at)
    rng = np.random.default_rng(_SEED)
    amounts = family.amounts(run)
    low, high = amounts.min(axis=0), amounts.max(axis=0)
    weights = np.sqrt(np.square(family.moves(run)).sum(axis=1).mean(axis=0))
    as_is = family.moved_by(run, numbers) * weights
    variance = max(float(as_is.var(axis=0).sum()), 1e-300)
    found = set(family.at)
    for k in range(run.motion.q.shape[1]):
        q = run.motion.q.copy()
        q[:, k] = rng.permutation(q[:, k])
        other = run.simulation.run(replace(run.motion, q=q))
        there = family.amounts(other)
        margin = _BEYOND * (high - low) + 1e-12
        seen = ((there >= low - margin) & (there <= high + margin)).all(axis=1)
        change = family.moved_by(other, numbers)[seen] * weights - as_is[seen]
        if seen.any() and 0.5 * float(np.square(change).sum(axis=1).mean()) >= _SHOWS * variance:
            found.add(k)
    return frozenset(found)
