"""Interface of a competitor: the problem it gets, and the fitted model it returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from kbmaps import ChainTolerances, RigidChain
from kbmaps.arrays import FloatArray

# Readings (n, 3) [m] of a marker at q (n, d) [rad] that sits `shift` (3,) [m] from the usual one, in its frame.
Measure = Callable[[FloatArray, FloatArray], FloatArray]


class Fitted(Protocol):
    """A fitted model."""

    def predict(self, q: FloatArray, /) -> FloatArray:
        """Return positions (n, 3) [m] at q (n, d) [rad]."""
        ...


@dataclass(frozen=True)
class Problem:
    """One fit: the pairs and all prior knowledge.

    Attributes:
        q, x: pairs, (n, d) [rad] and (n, 3) [m].
        low, high: the joints' working range (d,) [rad]; the pairs may cover only part of it.
        rng: random generator for the competitor.
        sigma: noise of a coordinate [m]; None if unknown (recordings).
        drawing: the nominal chain; None if there is no prior model.
        tolerances: possible deviation of the real arm from it.
        measure: takes readings at poses that the competitor chooses; None if the poses are given.
        tool_move: distance by which the marker was moved since an earlier fit [m]; None if it was not.
    """

    q: FloatArray
    x: FloatArray
    low: FloatArray
    high: FloatArray
    rng: np.random.Generator
    sigma: float | None = None
    drawing: RigidChain | None = None
    tolerances: ChainTolerances | None = None
    measure: Measure | None = None
    tool_move: float | None = None

    @property
    def joints(self) -> int:
        return self.q.shape[1]

    @property
    def pairs(self) -> int:
        return len(self.q)

    def scaled(self, q: FloatArray) -> FloatArray:
        """Return angles with the working range as -1 .. 1."""
        return (2.0 * q - self.low - self.high) / (self.high - self.low)


Learn = Callable[[Problem, Fitted | None], Fitted]
Refusal = Callable[[Problem], str | None]


@dataclass(frozen=True)
class Competitor:
    """One line of the figures.

    Attributes:
        key: short name, as on the command line.
        title: name on the page.
        family: "ours" or "peer".
        learn: fits a problem; the second argument is its earlier fit, from before the tool change.
        refuses: returns the reason why it cannot run on a problem, or None.
        calibrates: True if it fits the parameters of the nominal model all at once, or keeps them.
        about: description of the implementation, for the page.
    """

    key: str
    title: str
    family: Literal["ours", "peer"]
    learn: Learn
    about: str
    refuses: Refusal = lambda _: None
    calibrates: bool = False


@dataclass(frozen=True)
class Offset:
    """A start (nothing, a nominal model, or the model before a tool change) whose errors a black box learns."""

    start: Fitted | None
    mean: FloatArray

    @classmethod
    def of(cls, problem: Problem, earlier: Fitted | None) -> Offset:
        start = earlier if earlier is not None else _Drawn(problem.drawing) if problem.drawing is not None else None
        rest = problem.x if start is None else problem.x - start.predict(problem.q)
        return cls(start, rest.mean(axis=0))

    def predict(self, q: FloatArray) -> FloatArray:
        base = np.broadcast_to(self.mean, (len(q), 3))
        return base if self.start is None else base + self.start.predict(q)


@dataclass(frozen=True)
class _Drawn:
    chain: RigidChain

    def predict(self, q: FloatArray) -> FloatArray:
        return self.chain.positions(q)


def drawn(chain: RigidChain) -> Fitted:
    """Return the nominal model itself as a fitted model."""
    return _Drawn(chain)


def needs_drawing(problem: Problem) -> str | None:
    return "starts from a drawing" if problem.drawing is None else None


def needs_measuring(problem: Problem) -> str | None:
    return "needs poses of its own choosing, which this task does not grant" if problem.measure is None else None


def at_most(joints: int, why: str) -> Refusal:
    return lambda problem: why if problem.joints > joints else None


def any_of(*refusals: Refusal) -> Refusal:
    """Combine refusals: return the first reason that applies."""
    return lambda problem: next((reason for check in refusals if (reason := check(problem)) is not None), None)
