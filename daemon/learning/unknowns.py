"""What the data leave open, and how much that may be in metres."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray
from kbmaps import ChainBelief, JointBasis, ResidualModel, SupportSet

from .memory import IntArray

Predict = Callable[[FloatArray], FloatArray]


class Where:
    """Configurations q (n, d) [rad] that several claims are asked at: what these have in common is found once."""

    def __init__(self, q: FloatArray) -> None:
        self.q = q
        # By identity; who is asked is kept, so that no other gets its number.
        self._left_open: dict[int, tuple[SupportSet, FloatArray]] = {}
        self._chains: dict[int, tuple[ChainBelief | ResidualModel, tuple[FloatArray, FloatArray]]] = {}

    def at(self, rows: IntArray) -> Where:
        """Some of them, with what was found there."""
        part = Where(self.q[rows])
        part._left_open = {k: (of, left[rows]) for k, (of, left) in self._left_open.items()}
        part._chains = {k: (of, (x[rows], variance[rows])) for k, (of, (x, variance)) in self._chains.items()}
        return part

    def unexplained(self, support: SupportSet | None) -> FloatArray:
        """As the function of that name."""
        if support is None:
            return np.ones(len(self.q))
        if id(support) not in self._left_open:
            self._left_open[id(support)] = support, unexplained(support, self.q)
        return self._left_open[id(support)][1]

    def chain(self, belief: ChainBelief | ResidualModel) -> tuple[FloatArray, FloatArray]:
        """Positions and the variance of each coordinate, both (n, 3) [m, m²]."""
        if id(belief) not in self._chains:
            self._chains[id(belief)] = belief, belief.predict_with_variance(self.q)
        return self._chains[id(belief)][1]


@dataclass(frozen=True)
class Layer:
    """What is unknown where no data was.

    Attributes:
        support: where data was; None before any.
        sigma: 1-sigma of a coordinate far from all data [m].
    """

    support: SupportSet | None
    sigma: float

    def variance(self, where: Where) -> FloatArray:
        """Variance of a coordinate that is left open there, shape (n, 1) [m²]."""
        return where.unexplained(self.support)[:, None] * self.sigma**2


@dataclass(frozen=True, eq=False)
class ChainLayer:
    """What the data leave open of a chain, rigid or with what it does beside it."""

    belief: ChainBelief | ResidualModel

    def variance(self, where: Where) -> FloatArray:
        """Variance of each coordinate that is left open there, shape (n, 3) [m²]."""
        return where.chain(self.belief)[1]


@dataclass(frozen=True, eq=False)
class DepartureLayer:
    """How far a model is from the most probable chain: of the two, the chain is the one that the claim is known of.

    Attributes:
        predict: positions (n, 3) [m] that the model predicts at q (n, d) [rad].
        belief: what is believed of the chain.
        support: where the model itself was shown data; None: nowhere.
    """

    predict: Predict
    belief: ChainBelief
    support: SupportSet | None = None

    def variance(self, where: Where) -> FloatArray:
        """Squared difference of each coordinate there, shape (n, 3) [m²]."""
        departure = self.predict(where.q) - where.chain(self.belief)[0]
        return where.unexplained(self.support)[:, None] * np.square(departure)


def unexplained(support: SupportSet | None, q: FloatArray) -> FloatArray:
    """Share of the prior's variance that is left open at q (n, d) [rad], shape (n,), 0 to 1."""
    return np.ones(len(q)) if support is None else np.asarray(support.unexplained(q))


class GrowingSupport:
    """Where data was. Queries read it while it grows, so they get a copy; it grows ever more rarely.

    Args:
        bases: what is learnt in.
    """

    def __init__(self, bases: Sequence[JointBasis]) -> None:
        self._growing = SupportSet(bases)
        self._view: SupportSet | None = None

    @property
    def view(self) -> SupportSet | None:
        """What later pairs do not touch; None before any."""
        return self._view

    @property
    def configurations(self) -> FloatArray:
        """The configurations (n, d) [rad] that stand for all data."""
        return self._growing.configurations

    def add(self, q: FloatArray) -> None:
        """Pairs have been learnt at q (n, d) [rad]."""
        # What is known already joins no more after others have joined.
        new = q[self._growing.unexplained(q) > self._growing.threshold]
        if sum(self._growing.add(row) for row in new):
            self._view = copy.deepcopy(self._growing)
