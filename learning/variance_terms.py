"""Variance of predictions that remains after the data."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.replay_memory import IntArray
from kbmaps import ChainBelief, JointBasis, ResidualModel, SupportSet

Predict = Callable[[FloatArray], FloatArray]


class QueryPoints:
    """Configurations q (n, d) [rad] at which several uncertainties are evaluated; common parts are computed once."""

    def __init__(self, q: FloatArray) -> None:
        self.q = q
        # Keyed by identity; the object is kept alive, so that no other gets its id.
        self._unexplained_cache: dict[int, tuple[SupportSet, FloatArray]] = {}
        self._chains: dict[int, tuple[ChainBelief | ResidualModel, tuple[FloatArray, FloatArray]]] = {}

    def at(self, rows: IntArray) -> QueryPoints:
        """Return the configurations of some rows, with the results computed there."""
        part = QueryPoints(self.q[rows])
        part._unexplained_cache = {
            k: (source, unexplained_share[rows]) for k, (source, unexplained_share) in self._unexplained_cache.items()
        }
        part._chains = {k: (source, (x[rows], variance[rows])) for k, (source, (x, variance)) in self._chains.items()}
        return part

    def unexplained(self, support: SupportSet | None) -> FloatArray:
        """Return the result of the function of that name."""
        if support is None:
            return np.ones(len(self.q))
        if id(support) not in self._unexplained_cache:
            self._unexplained_cache[id(support)] = support, unexplained(support, self.q)
        return self._unexplained_cache[id(support)][1]

    def chain(self, belief: ChainBelief | ResidualModel) -> tuple[FloatArray, FloatArray]:
        """Return positions and the variance of each coordinate, both (n, 3) [m, m²]."""
        if id(belief) not in self._chains:
            self._chains[id(belief)] = belief, belief.predict_with_variance(self.q)
        return self._chains[id(belief)][1]


@dataclass(frozen=True)
class VarianceTerm:
    """Uncertainty away from data."""

    support: SupportSet | None  # support of the data; None without data
    sigma: float  # 1-sigma of a coordinate far from all data [m]

    def variance(self, points: QueryPoints) -> FloatArray:
        """Return the variance of a coordinate at these points, shape (n, 1) [m²]."""
        return points.unexplained(self.support)[:, None] * self.sigma**2


@dataclass(frozen=True, eq=False)
class ChainTerm:
    """Uncertainty of a chain after the data, rigid or with residual."""

    belief: ChainBelief | ResidualModel

    def variance(self, points: QueryPoints) -> FloatArray:
        """Return the variance of each coordinate at these points, shape (n, 3) [m²]."""
        return points.chain(self.belief)[1]


@dataclass(frozen=True, eq=False)
class DepartureTerm:
    """Distance of a model from the most probable chain: only the chain's uncertainty is known."""

    predict: Predict  # positions (n, 3) [m] that the model predicts at q (n, d) [rad]
    belief: ChainBelief  # posterior of the chain
    support: SupportSet | None = None  # support of the model's own data; None without data

    def variance(self, points: QueryPoints) -> FloatArray:
        """Return the squared difference of each coordinate at these points, shape (n, 3) [m²]."""
        departure = self.predict(points.q) - points.chain(self.belief)[0]
        return points.unexplained(self.support)[:, None] * np.square(departure)


def unexplained(support: SupportSet | None, q: FloatArray) -> FloatArray:
    """Return the fraction of the prior's variance that remains at q (n, d) [rad], shape (n,), 0 to 1."""
    return np.ones(len(q)) if support is None else np.asarray(support.unexplained(q))


class GrowingSupport:
    """Support of the data. Queries read it while it grows, so they get a copy, renewed at growing intervals.

    Args:
        bases: bases of the learnt maps.
    """

    def __init__(self, bases: Sequence[JointBasis]) -> None:
        self._growing = SupportSet(bases)
        self.view: SupportSet | None = None  # copy that later pairs do not change; None before the first

    @property
    def configurations(self) -> FloatArray:
        """Configurations (n, d) [rad] that represent all data."""
        return self._growing.configurations

    def add(self, q: FloatArray) -> None:
        """Record that pairs have been learnt at q (n, d) [rad]."""
        # A configuration that is already explained cannot join after others have joined.
        new = q[self._growing.unexplained(q) > self._growing.threshold]
        if sum(self._growing.add(row) for row in new):
            self.view = copy.deepcopy(self._growing)
