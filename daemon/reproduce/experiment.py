"""What an experiment gives: curves as the paper draws them, and readings to hold against its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from bodyschema.daemon.progress import Say
from bodyschema.interfaces.records import FloatArray

# The mean length of a noise vector with a unit standard deviation per axis: 2 √(2/π).
MEAN_NOISE = 2.0 * math.sqrt(2.0 / math.pi)

# Poses (n, d) [rad] and positions (n, 3) [m] of the marker in them, to learn.
Pairs = tuple[FloatArray, FloatArray]
# Poses (n, d) [rad] and where the marker is in them (n, 3) [m], by name.
Tests = Mapping[str, Pairs]


@dataclass(frozen=True)
class Run:
    """How an experiment is to be run.

    Attributes:
        rng: draws poses, noise and crude estimates.
        seed: of the simulated robot whose images are rendered.
        real: whether the measured curves are wanted, which take minutes.
        say: told what is being done.
    """

    rng: np.random.Generator
    seed: int
    real: bool
    say: Say


@dataclass
class Curve:
    """One line of a figure: errors [m] over the number of samples or cycles.

    Attributes:
        name: as the legend says it.
        colour: the paper's, where it has this curve.
        style: of the line, as matplotlib calls it.
        width: of the line [points].
        thin: varies from pair to pair; drawn in the background, as a band.
        count: samples or cycles (n,).
        mean: mean errors [m] (n,).
        largest: largest errors [m] (n,); empty where the figure has none.
    """

    name: str
    colour: str
    style: str = "-"
    width: float = 2.0
    thin: bool = False
    count: list[int] = field(default_factory=list)
    mean: list[float] = field(default_factory=list)
    largest: list[float] = field(default_factory=list)

    def add(self, count: int, errors: FloatArray) -> None:
        """The errors [m] (m,) at one count."""
        self.count.append(count)
        self.mean.append(float(errors.mean()))
        self.largest.append(float(errors.max()))

    def add_one(self, count: int, error_m: float) -> None:
        """A single error [m] at one count."""
        self.count.append(count)
        self.mean.append(error_m)

    def at(self, count: int) -> float | None:
        """The mean error [m] at the last count that is not larger; None before the first."""
        known = [mean for place, mean in zip(self.count, self.mean, strict=True) if place <= count]
        return known[-1] if known else None

    def first_below(self, limit_m: float) -> int | None:
        """The first count from which on the mean error stays below the limit [m]."""
        above = [place for place, mean in enumerate(self.mean) if mean >= limit_m]
        place = above[-1] + 1 if above else 0
        return self.count[place] if place < len(self.count) else None


@dataclass(frozen=True)
class Panel:
    """One plot of a figure.

    Attributes:
        title: what it shows.
        curves: its lines.
        as_paper: drawn as the paper draws it: counts on a linear axis, and the largest errors too, dotted. Otherwise
            counts are on a logarithmic one, from 1 on.
        styles: what a line's style means, where it means something.
    """

    title: str
    curves: Sequence[Curve]
    as_paper: bool = False
    styles: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Reading:
    """One figure of the paper beside ours, under one reading of what the paper leaves open.

    Attributes:
        what: what was measured.
        read_as: how the paper was read here.
        paper: what the paper says.
        value: what its method gave here; None where it was not reached.
        unit: of the value.
    """

    what: str
    read_as: str
    paper: str
    value: float | None
    unit: Literal["m", "samples", "s"] = "m"


@dataclass(frozen=True)
class Column:
    """Where a comparison was tested, and after how many pairs."""

    test: str
    count: int


@dataclass(frozen=True)
class Comparison:
    """Other models on the same pairs.

    Attributes:
        title: what the numbers are.
        columns: where it was tested, and after how many pairs.
        rows: mean errors [m], one a column, by model; None where a model says nothing yet.
    """

    title: str
    columns: Sequence[Column]
    rows: Mapping[str, Sequence[float | None]]


@dataclass(frozen=True)
class Experiment:
    """What one experiment gave.

    Attributes:
        name: as on the command line.
        title: what it is.
        counted: what the curves' counts are.
        panels: the plots of the figure, the paper's own first.
        readings: the paper's figures beside ours.
        comparison: other models on the same pairs.
        notes: what the paper leaves open, and how it was read here.
        floor_m: lengths below are drawn as this one [m].
    """

    name: str
    title: str
    counted: str
    panels: Sequence[Panel]
    readings: Sequence[Reading]
    comparison: Comparison | None
    notes: Sequence[str]
    floor_m: float = 1e-5


def distances(x: FloatArray, other: FloatArray) -> FloatArray:
    """Distances [m] (n,) between positions, both (n, 3)."""
    return np.linalg.norm(x - other, axis=1)
