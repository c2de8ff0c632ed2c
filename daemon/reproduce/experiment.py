"""What an experiment gives: curves as the paper draws them, and readings to hold against its figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from interfaces.records import FloatArray
from kbmaps import KBMap

# Lengths below are rounding errors [m].
ROUNDING_M = 1e-12


@dataclass
class Curve:
    """One line of a figure: errors [m] over the number of samples or cycles.

    Attributes:
        name: as the legend says it.
        colour: the paper's, where it has this curve.
        count: samples or cycles (n,).
        mean: mean errors [m] (n,).
        largest: largest errors [m] (n,); empty where the figure has none.
        thin: drawn in the background.
    """

    name: str
    colour: str
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

    def at(self, count: int) -> float:
        """The mean error [m] at the last count that is not larger."""
        places = [place for place, known in enumerate(self.count) if known <= count]
        return self.mean[places[-1]]

    def first_below(self, limit_m: float) -> int | None:
        """The first count from which on the mean error stays below the limit [m]."""
        above = [place for place, mean in enumerate(self.mean) if mean >= limit_m]
        place = above[-1] + 1 if above else 0
        return self.count[place] if place < len(self.count) else None


@dataclass(frozen=True)
class Reading:
    """One figure of the paper beside ours.

    Attributes:
        what: what was measured.
        paper: what the paper says.
        method: what the paper's method gave here.
        learner: what the daemon's learner gave on the same pairs.
    """

    what: str
    paper: str
    method: str
    learner: str = ""


@dataclass(frozen=True)
class Experiment:
    """What one experiment gave.

    Attributes:
        name: as on the command line.
        title: what it is.
        counted: what the curves' counts are.
        curves: the lines of the figure.
        readings: the paper's figures beside ours.
        notes: what the paper leaves open, and how it was read here.
        floor_m: lengths below are drawn as this one [m].
    """

    name: str
    title: str
    counted: str
    curves: Sequence[Curve]
    readings: Sequence[Reading]
    notes: Sequence[str]
    floor_m: float = 1e-5


def distances(kbmap: KBMap, q: FloatArray, x: FloatArray) -> FloatArray:
    """Distances [m] (n,) between the map's positions at q (n, d) and x (n, 3)."""
    return np.linalg.norm(kbmap.predict(q) - x, axis=1)


def mm(length_m: float) -> str:
    """A length in mm, in three digits; rounding errors are told as such."""
    return f"{1e3 * length_m:.3g} mm" if length_m >= ROUNDING_M else f"below {1e3 * ROUNDING_M:.0e} mm"
