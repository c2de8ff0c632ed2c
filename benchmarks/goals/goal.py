"""Goals, the figures compared with them, and the rows of the table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from benchmarks.goals.study import Estimate, Measured, Study, Values

# A goal is this many times what the posterior of the right model leaves, where that is more than the number.
BOUND_FACTOR = 1.15


class Verdict(Enum):
    """Verdict on a figure against its goal."""

    MET = "met"
    NOT_MET = "**not met**"
    OPEN = "not measured"


@dataclass(frozen=True)
class Goal:
    """Target range of a figure: at least `low` and at most `high`, in `unit`."""

    low: float = -math.inf
    high: float = math.inf
    unit: str = ""

    def text(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.low):
            return f"≤ {number(self.high)}{unit}"
        if math.isinf(self.high):
            return f"≥ {number(self.low)}{unit}"
        return f"{number(self.low)} to {number(self.high)}{unit}"

    def with_bound(self, bound: Measured | None) -> Goal:
        """Return the goal, raised to 1.15 times the bound where that is more."""
        return self if bound is None else Goal(self.low, max(self.high, BOUND_FACTOR * bound.value), self.unit)


def at_most(high: float, unit: str = "") -> Goal:
    return Goal(high=high, unit=unit)


def at_least(low: float, unit: str = "") -> Goal:
    return Goal(low=low, unit=unit)


def between(low: float, high: float, unit: str = "") -> Goal:
    return Goal(low, high, unit)


@dataclass(frozen=True)
class Figure:
    """One number of a row.

    Attributes:
        what: the measured quantity.
        studies: studies that measure it.
        bound: the posterior of the right model, from the same seeds.
    """

    what: str
    studies: tuple[Study, ...]
    estimate: Estimate
    goal: Goal
    bound: Estimate | None = None


@dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        name: name on the command line.
        what: the aim.
    """

    name: str
    what: str
    figures: tuple[Figure, ...]

    @property
    def studies(self) -> tuple[Study, ...]:
        """Return the row's studies, each once."""
        return tuple({study.key: study for figure in self.figures for study in figure.studies}.values())


@dataclass(frozen=True)
class Cell:
    """A figure from the seeds measured so far.

    Attributes:
        seeds, wanted: numbers of seeds measured (the smallest of its studies) and required.
        goal: the goal, bound included.
        in_doubt: True if the goal is within two standard errors.
    """

    figure: Figure
    seeds: int
    wanted: int
    measured: Measured | None
    bound: Measured | None
    goal: Goal

    @property
    def verdict(self) -> Verdict:
        if self.measured is None:
            return Verdict.OPEN
        return Verdict.MET if self.goal.low <= self.measured.value <= self.goal.high else Verdict.NOT_MET

    @property
    def in_doubt(self) -> bool:
        if self.measured is None or self.measured.standard_error is None:
            return False
        nearest = min(abs(self.measured.value - limit) for limit in (self.goal.low, self.goal.high))
        return nearest < 2.0 * self.measured.standard_error


def judged(figure: Figure, results: Mapping[str, Sequence[Values]]) -> Cell:
    """Compare a figure with its goal, over all measured seeds of its studies."""
    samples = [results.get(study.key, ()) for study in figure.studies]
    seeds, wanted = min(map(len, samples)), min(study.seeds for study in figure.studies)
    if not seeds:
        return Cell(figure, 0, wanted, None, None, figure.goal)
    bound = None if figure.bound is None else figure.bound(samples)
    return Cell(figure, seeds, wanted, figure.estimate(samples), bound, figure.goal.with_bound(bound))


def number(value: float) -> str:
    """Format with three digits; format infinity as "never"."""
    if math.isinf(value):
        return "never"
    if value != 0.0 and abs(value) < 1e-3:
        return f"{value:.1e}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
