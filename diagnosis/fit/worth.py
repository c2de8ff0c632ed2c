"""Weigh causes: what their parameters and the choice among hypotheses cost, in nats."""

from __future__ import annotations

import math

import numpy as np

from bodyschema.effects import Effect

# Signals that differ by less than this, twice the log-likelihood that the right one is expected to gain, are one.
SAME = 6.0
# Smallest evidence gain of a cause [nats].
NAMED = 3.0
# Cost of each further joint with the same kind of error, which is often set in one session [nats].
ANOTHER = 2.0
# Minimum cost of a parameter [nats].
_CHEAPEST = 1.5
# Fixed-point rounds of `rise_for`.
_ROUNDS = 30


def nats(gain: float, dof: int) -> float:
    """Return the evidence gain of `dof` more parameters that raise twice the log-likelihood by `gain` [nats].

    The prior is Gaussian and scaled by empirical Bayes: the size that best explains the gain (George and Foster 2000,
        equation 5). It is never so narrow that a parameter costs less than `_CHEAPEST`.
    """
    if dof < 0:
        return -nats(-gain, -dof)
    if dof == 0:
        return 0.5 * gain
    return 0.5 * gain - dof * max(0.5 + 0.5 * float(np.log(max(gain, 1e-300) / dof)), _CHEAPEST)


def rise_for(worth: float, dof: int) -> float:
    """Return the rise of the log-likelihood for which `dof` more parameters are worth `worth` by `nats` [nats]."""
    if dof < 0:
        return -rise_for(-worth, -dof)
    rise = worth + _CHEAPEST * dof
    for _ in range(_ROUNDS if dof else 0):
        rise = worth + dof * max(0.5 + 0.5 * float(np.log(max(2.0 * rise, 1e-300) / dof)), _CHEAPEST)
    return rise


def choices(effect: Effect) -> int:
    """Return the number of ways in which the amounts of an effect could have been chosen."""
    if not effect.kind.in_parts or effect.free is None:
        return 1
    return ways_to_choose(len(effect.amounts), len(effect.freeing(None).amounts))


def ways_to_choose(some: int, of: int) -> int:
    """Return the number of sets of this size, times the number of sizes: any size is equally probable."""
    return of * math.comb(of, some)
