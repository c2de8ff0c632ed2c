"""Results of an experiment: curves as the paper plots them, and figures to compare with the paper's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from bodyschema.cli.terminal.screen import Say
from bodyschema.interfaces.records import FloatArray

# Mean length of a noise vector with unit standard deviation per axis: 2 √(2/π).
MEAN_NOISE = 2.0 * math.sqrt(2.0 / math.pi)

# Training data: poses (n, d) [rad] and marker positions (n, 3) [m].
Pairs = tuple[FloatArray, FloatArray]
# Test data by name: poses (n, d) [rad] and marker positions (n, 3) [m].
Tests = Mapping[str, Pairs]


@dataclass(frozen=True)
class Run:
    """Settings of a run.

    Attributes:
        rng: generator for poses, noise and crude estimates.
        seed: seed of the simulated robot whose images are rendered.
        real: True to compute the measured curves, which take minutes.
        say: called with progress messages.
    """

    rng: np.random.Generator
    seed: int
    real: bool
    say: Say


@dataclass
class Curve:
    """One line of a figure: errors [m] over the number of samples or cycles.

    Attributes:
        name: name in the legend.
        colour: the paper's colour, if it has this curve.
        style: line style, in matplotlib's notation.
        width: line width [points].
        thin: True for values that vary from pair to pair; they are plotted in the background, as a band.
        count: samples or cycles (n,).
        mean: mean errors [m] (n,).
        largest: largest errors [m] (n,); empty if the figure has none.
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
        """Add the errors [m] (m,) at one count."""
        self.count.append(count)
        self.mean.append(float(errors.mean()))
        self.largest.append(float(errors.max()))

    def add_one(self, count: int, error_m: float) -> None:
        """Add a single error [m] at one count."""
        self.count.append(count)
        self.mean.append(error_m)

    def at(self, count: int) -> float | None:
        """Return the mean error [m] at the largest count up to this one; None before the first."""
        known = [mean for place, mean in zip(self.count, self.mean, strict=True) if place <= count]
        return known[-1] if known else None

    def first_below(self, limit_m: float) -> int | None:
        """Return the first count from which on the mean error stays below the limit [m]."""
        above = [place for place, mean in enumerate(self.mean) if mean >= limit_m]
        place = above[-1] + 1 if above else 0
        return self.count[place] if place < len(self.count) else None


@dataclass(frozen=True)
class Panel:
    """One plot of a figure.

    Attributes:
        title: the shown quantity.
        curves: its lines.
        as_paper: True to plot as the paper does: counts on a linear axis, and the largest errors too, dotted. Otherwise
            the axis of the counts is logarithmic, from 1 on.
        styles: meaning of the line styles, where they have one.
    """

    title: str
    curves: Sequence[Curve]
    as_paper: bool = False
    styles: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Reading:
    """A figure of the paper and ours, under one interpretation of what the paper leaves open.

    Attributes:
        what: the measured quantity.
        read_as: the interpretation of the paper.
        paper: the paper's figure.
        value: our figure with the paper's method; None if it was not reached.
        unit: unit of the value.
    """

    what: str
    read_as: str
    paper: str
    value: float | None
    unit: Literal["m", "samples", "s"] = "m"


@dataclass(frozen=True)
class Column:
    """The test set of a comparison, and the number of pairs learnt."""

    test: str
    count: int


@dataclass(frozen=True)
class Comparison:
    """Other models on the same pairs.

    Attributes:
        title: meaning of the numbers.
        columns: test set and number of pairs of each column.
        rows: mean errors [m], one per column, by model; None if a model has no prediction yet.
    """

    title: str
    columns: Sequence[Column]
    rows: Mapping[str, Sequence[float | None]]


@dataclass(frozen=True)
class Experiment:
    """Result of one experiment.

    Attributes:
        name: name on the command line.
        title: description.
        counted: meaning of the curves' counts.
        panels: the plots of the figure, the paper's own first.
        readings: the paper's figures and ours.
        comparison: other models on the same pairs.
        notes: questions that the paper leaves open, and their interpretation.
        floor_m: lengths below this are plotted as this one [m].
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
    """Return the distances [m] (n,) between positions, both (n, 3)."""
    return np.linalg.norm(x - other, axis=1)
