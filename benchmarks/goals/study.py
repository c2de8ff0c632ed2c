"""Studies, which measure one seed at a time, and estimates over their seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray

# Values of one seed of a study, by name, in the unit shown.
Values = Mapping[str, float]


class NotHereError(Exception):
    """Something that a study needs is missing; the message tells how to get it."""


@dataclass(frozen=True)
class Study:
    """One set-up.

    Attributes:
        key: key under which its seeds are saved.
        run: measures one seed.
        seeds: required number of seeds.
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
    """Estimate the mean over all seeds, or the rate if the values are zeros and ones."""
    return lambda samples: _mean(_all(name, samples))


def worst(name: str) -> Estimate:
    """Estimate the maximum over all seeds."""
    return lambda samples: Measured(float(_all(name, samples).max()))


def least(name: str) -> Estimate:
    """Estimate the minimum over all seeds; for times, that of the least disturbed run."""
    return lambda samples: Measured(float(_all(name, samples).min()))


def median(name: str) -> Estimate:
    """Estimate the median over all seeds."""
    return lambda samples: Measured(float(np.median(_all(name, samples))))


def share_below(name: str, level: float) -> Estimate:
    """Estimate the share of seeds at or below a level [%]."""
    return lambda samples: _mean(100.0 * (_all(name, samples) <= level).astype(np.float64))


def ratio(above: str, below: str) -> Estimate:
    """Estimate the ratio of two means over the same seeds, with a first-order standard error."""

    def estimate(samples: Sequence[Sequence[Values]]) -> Measured:
        top, bottom = _all(above, samples), _all(below, samples)
        value = float(top.mean() / bottom.mean())
        off = _mean((top - value * bottom) / bottom.mean())
        return Measured(value, off.standard_error)

    return estimate


def lowest(name: str) -> Estimate:
    """Estimate the lowest of the studies' means."""
    return lambda samples: min((_mean(_all(name, [one])) for one in samples), key=lambda each: each.value)


def highest(name: str) -> Estimate:
    """Estimate the highest of the studies' means."""
    return lambda samples: max((_mean(_all(name, [one])) for one in samples), key=lambda each: each.value)


def first_below(names: Mapping[int, str], level: float) -> Estimate:
    """Estimate the size at which the mean first falls to a level, interpolated log-log between sizes.

    The estimate is infinite if the mean never falls that far.
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
