"""Weigh causes: the cost of their parameters and of the choice among hypotheses, in nats."""

from __future__ import annotations

import math

import numpy as np

from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray


class WorthSettings:
    # Signals that differ by less than this, twice the log-likelihood that the right one is expected to gain, are one.
    same = 6.0
    named_nats = 3.0  # smallest evidence gain of a cause [nats]
    # Cost of each further joint with the same kind of error, which is often set in one session [nats].
    another_nats = 2.0
    cheapest_nats = 1.5  # minimum cost of a parameter [nats]
    rounds = 30  # fixed-point rounds of `required_rise`


def evidence_gain(gain: float, dof: int) -> float:
    """Return the evidence gain of `dof` more parameters that raise twice the log-likelihood by `gain` [nats]."""
    if dof < 0:
        return -evidence_gain(-gain, -dof)
    return 0.5 * gain - parameter_cost(gain, dof)


def parameter_cost(gain: float, dof: int) -> float:
    """Return the cost of `dof` parameters that raise twice the log-likelihood by `gain` [nats].

    The prior is Gaussian and scaled by empirical Bayes: the size that best explains the gain (George and Foster 2000,
        equation 5). It is never so narrow that a parameter costs less than `WorthSettings.cheapest_nats`.
    """
    return dof * max(0.5 + 0.5 * math.log(max(gain, 1e-300) / dof), WorthSettings.cheapest_nats) if dof else 0.0


def required_rise(evidence: float, dof: int) -> float:
    """Return the rise of the log-likelihood at which `dof` more parameters gain `evidence` [nats]."""
    if dof < 0:
        return -required_rise(-evidence, -dof)
    rise = evidence + WorthSettings.cheapest_nats * dof
    for _ in range(WorthSettings.rounds if dof else 0):
        rise = evidence + parameter_cost(2.0 * rise, dof)
    return rise


def choice_count(effect: Effect) -> float:
    """Return the effective number of equally probable choices of an effect's free amounts."""
    if not effect.kind.in_parts or effect.free is None:
        return 1.0
    return float(choice_counts(effect)[sum(1 << k for k in effect.amounts)])


def choice_counts(effect: Effect) -> FloatArray:
    """Return the number of equally probable ways in which each set of an effect's numbers could have been chosen.

    In half of the cases the set is complete: all shifts, all rotations, or both, for a part that is mounted askew. In
    the other half it is any subset, with equal probability.

    Returns:
        One number for each sum of 2ᵏ over the free numbers k.
    """
    amounts = effect.with_free_amounts(None).amounts
    units: dict[str, int] = {}
    for k in amounts:
        unit = effect.parameters[k].name.rpartition("_")[2]
        units[unit] = units.get(unit, 0) + (1 << k)
    wholes = {*units.values(), sum(units.values())}
    ways = np.full(1 << len(amounts), np.inf)
    for chosen in range(1, len(ways)):
        size = chosen.bit_count()
        any_set = 1.0 / (len(amounts) * math.comb(len(amounts), size))
        ways[chosen] = 2.0 / (any_set + (1.0 / len(wholes) if chosen in wholes else 0.0))
    return ways
