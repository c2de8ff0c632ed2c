"""On which joints an error without a name depends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodyschema.effects import Simulated
from bodyschema.interfaces.records import FloatArray

from .families import Family

# From this share of its variance on an error depends on a joint: what holds less leads nobody to its cause.
_SHOWS = 0.05
# What goes farther beyond all that was seen than this share of its range is not judged.
_BEYOND = 0.1
_SEED = 0


def joints_of(family: Family, numbers: FloatArray, run: Simulated) -> frozenset[int]:
    """The joints that err or on which the error depends, by their places in q.

    Args:
        numbers: of the family (p,).
    """
    own = frozenset[int]() if family.joint is None else frozenset({family.joint})
    if family.over_time:
        return own
    return own | frozenset(np.flatnonzero(shares(family, numbers, run) >= _SHOWS).tolist())


def shares(family: Family, numbers: FloatArray, run: Simulated) -> FloatArray:
    """Which share of the error's variance each joint holds, the others given (d,).

    Half the mean square change when this joint alone is taken from another row (Jansen 1999).

    Args:
        numbers: of the family (p,).
    """
    rng = np.random.default_rng(_SEED)
    amounts, moves = family.amounts(run), family.moves(run)
    low, high = amounts.min(axis=0), amounts.max(axis=0)
    margin = _BEYOND * (high - low) + 1e-12
    by = family.moved_by(run, numbers)
    # Where each row's moves are and stay: how a joint carries the error along to the marker does not count.
    lengths = np.einsum("nia,nib->nab", moves, moves)
    variance = _square(lengths, by - by.mean(axis=0))
    found = np.zeros(run.motion.q.shape[1])
    for k in range(len(found)):
        q = run.motion.q.copy()
        q[:, k] = rng.permutation(q[:, k])
        other = run.simulation.run(replace(run.motion, q=q))
        there = family.amounts(other)
        seen = ((there >= low - margin) & (there <= high + margin)).all(axis=1)
        change = (family.moved_by(other, numbers) - by)[seen]
        if seen.any():
            found[k] = 0.5 * _square(lengths[seen], change) / max(variance, 1e-300)
    return found


def _square(lengths: FloatArray, by: FloatArray) -> float:
    """Mean square of how far moves by (n, a) take the marker [m²]; `lengths` (n, a, a) are the moves' products."""
    return float(np.einsum("na,nab,nb->n", by, lengths, by).mean())
