"""Studies, which measure one seed at a time, and estimates over their seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray

# What one seed of a study gives, by name, in the unit that is shown.
Values = Mapping[str, float]


class NotHereError(Exception):
    """Something that a study needs is not there; the message says what to do."""


@dataclass(frozen=True)
class Study:
    """One set-up.

    Attributes:
        key: what its seeds are kept under.
        run: measures one seed.
        seeds: how many are wanted.
    """

    key: str
    run: Callable[[int], Values]
    seeds: int = 50


@dataclass(frozen=True)
class Measured:
    """A figure, with its standard error where there are several seeds."""

    value: float
    standard_error: float | None = None


# Takes the seeds of each study of a figure.
Estimate = Callable[[Sequence[Sequence[Values]]], Measured]


def mean(name: str) -> Estimate:
    """The mean over all seeds. Of zeros and ones it is a rate."""
    return lambda samples: _mean(_all(name, samples))


def worst(name: str) -> Estimate:
    """The largest over all seeds."""
    return lambda samples: Measured(float(_all(name, samples).max()))


def least(name: str) -> Estimate:
    """The smallest over all seeds: of times, what the machine takes when it is disturbed least."""
    return lambda samples: Measured(float(_all(name, samples).min()))


def median(name: str) -> Estimate:
    """The median over all seeds."""
    return lambda samples: Measured(float(np.median(_all(name, samples))))


def share_below(name: str, level: float) -> Estimate:
    """The share of seeds at or below a level [%]."""
    return lambda samples: _mean(100.0 * (_all(name, samples) <= level).astype(np.float64))


def ratio(above: str, below: str) -> Estimate:
    """The ratio of two means over the same seeds; its standard error to first order."""

    def estimate(samples: Sequence[Sequence[Values]]) -> Measured:
        top, bottom = _all(above, samples), _all(below, samples)
        value = float(top.mean() / bottom.mean())
        off = _mean((top - value * bottom) / bottom.mean())
        return Measured(value, off.standard_error)

    return estimate


def lowest(name: str) -> Estimate:
    """The lowest of the studies' means."""
    return lambda samples: min((_mean(_all(name, [one])) for one in samples), key=lambda each: each.value)


def highest(name: str) -> Estimate:
    """The highest of the studies' means."""
    return lambda samples: max((_mean(_all(name, [one])) for one in samples), key=lambda each: each.value)


def first_below(names: Mapping[int, str], level: float) -> Estimate:
    """The size at which the mean first falls to a level, between sizes by a straight line in logarithms.

    Infinite where it never does.
    """

    def estimate(samples: Sequence[Sequence[Values]]) -> Measured:
        sizes = np.log(np.array(list(names), dtype=np.float64))
        means = np.log(np.minimum.accumulate([_all(name, samples).mean() for name in names.values()]))
        if means[-1] > math.log(level):
            return Measured(math.inf)
        return Measured(float(np.exp(np.interp(-math.log(level), -means, sizes))))

    return estimate


def _all(name: str, samples: Sequence[Sequence[Values]]) -> FloatArray:
    return np.array([values[name] for one in samples for values in one])


def _mean(values: FloatArray) -> Measured:
    error = float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else None
    return Measured(float(values.mean()), error)
