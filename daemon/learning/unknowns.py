"""What the data leave open, and how much that may be in metres."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from interfaces.records import FloatArray
from kbmaps import ChainBelief, JointBasis, ResidualModel, SupportSet

Predict = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Layer:
    """What is unknown where no data was.

    Attributes:
        support: where data was; None before any.
        sigma: 1-sigma of a coordinate far from all data [m].
    """

    support: SupportSet | None
    sigma: float

    def variance(self, q: FloatArray) -> FloatArray:
        """Variance of a coordinate that is left open at q (n, d) [rad], shape (n, 1) [m²]."""
        return unexplained(self.support, q)[:, None] * self.sigma**2


@dataclass(frozen=True, eq=False)
class ChainLayer:
    """What the data leave open of a chain, rigid or with what it does beside it."""

    belief: ChainBelief | ResidualModel

    def variance(self, q: FloatArray) -> FloatArray:
        """Variance of each coordinate that is left open at q (n, d) [rad], shape (n, 3) [m²]."""
        return self.belief.predict_with_variance(q)[1]


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

    def variance(self, q: FloatArray) -> FloatArray:
        """Squared difference of each coordinate at q (n, d) [rad], shape (n, 3) [m²]."""
        return unexplained(self.support, q)[:, None] * np.square(self.predict(q) - self.belief.predict(q))


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
        """A pair has been learnt at q (d,) [rad]."""
        if self._growing.add(q):
            self._view = copy.deepcopy(self._growing)
