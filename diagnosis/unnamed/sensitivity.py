"""Find the joints on which an unnamed error depends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodyschema.effects import Simulated
from bodyschema.interfaces.records import FloatArray

from .families import Family

# Smallest share of the variance at which an error counts as depending on a joint.
_SHOWS = 0.05
# Limit of extrapolation beyond the observed range, as a share of it.
_BEYOND = 0.1
_SEED = 0


def joints_of(family: Family, numbers: FloatArray, run: Simulated) -> frozenset[int]:
    """Return the joints that err or on which the error depends, by their indices in q.

    Args:
        numbers: parameters of the family (p,).
    """
    own = frozenset[int]() if family.joint is None else frozenset({family.joint})
    if family.over_time:
        return own
    return own | frozenset(np.flatnonzero(shares(family, numbers, run) >= _SHOWS).tolist())


def shares(family: Family, numbers: FloatArray, run: Simulated) -> FloatArray:
    """Return the share of the error's variance due to each joint, the others given (d,).

    It is half the mean square change when only this joint is taken from another row (Jansen 1999).

    Args:
        numbers: parameters of the family (p,).
    """
    rng = np.random.default_rng(_SEED)
    amounts, moves = family.amounts(run), family.moves(run)
    low, high = amounts.min(axis=0), amounts.max(axis=0)
    margin = _BEYOND * (high - low) + 1e-12
    by = family.moved_by(run, numbers)
    # Keep each row's directions fixed: the leverage of a joint on the marker does not count.
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
    """Return the mean square displacement by moves (n, a) [m²]; `lengths` (n, a, a) are their products."""
    return float(np.einsum("na,nab,nb->n", by, lengths, by).mean())
