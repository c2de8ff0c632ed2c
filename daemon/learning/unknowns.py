"""What the data leave open, and how much that may be in metres."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from interfaces.records import FloatArray
from kbmaps import ChainBelief, JointBasis, ResidualModel, SupportSet


@dataclass(frozen=True)
class Layer:
    """One thing that is unknown where no data was: the arm's own shape, or what a changed tool did to it.

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


def unexplained(support: SupportSet | None, q: FloatArray) -> FloatArray:
    """Share of the prior's variance that is left open at q (n, d) [rad], shape (n,), 0 to 1."""
    return np.ones(len(q)) if support is None else np.asarray(support.unexplained(q))


class Unknowns:
    """Follows where pairs have shown the arm with any tool, and with the present one.

    A tool that is fitted anew brings the prior close to the recent pairs, and its error there says nothing about other
    places: what was never seen of the arm with an earlier tool is still unknown. So its shape is a layer of its own.
    """

    def __init__(self, bases: Sequence[JointBasis]) -> None:
        self._bases = bases
        self._arm = _GrowingSupport(bases)
        self._tool = self._arm
        self._arm_sigma: float | None = None

    @property
    def arm_configurations(self) -> FloatArray:
        """The configurations (n, d) [rad] that stand for all data, with any tool."""
        return self._arm.growing.configurations

    @property
    def arm_sigma(self) -> float | None:
        """1-sigma of the prior before the tool was changed [m]; None if it never was."""
        return self._arm_sigma

    @property
    def support(self) -> SupportSet | None:
        """Where data with the present tool was; None before any."""
        return self._tool.view

    def add(self, q: FloatArray) -> None:
        """A pair has been learnt at q (d,) [rad]."""
        self._arm.add(q)
        if self._tool is not self._arm:
            self._tool.add(q)

    def change_tool(self, sigma: float) -> None:
        """From now on another tool; `sigma` is how wrong the prior was [m]."""
        self._arm_sigma = max(self._arm_sigma or 0.0, sigma)
        self._tool = _GrowingSupport(self._bases)

    def layers(self, sigma: float) -> tuple[Layer, ...]:
        """What is left open; `sigma` is how wrong the present prior is [m]."""
        if self._arm_sigma is None:
            return (Layer(self._arm.view, sigma),)
        return Layer(self._tool.view, sigma), Layer(self._arm.view, self._arm_sigma)


class _GrowingSupport:
    """Queries read a support set while it grows, so they get a copy; it grows ever more rarely."""

    def __init__(self, bases: Sequence[JointBasis]) -> None:
        self.growing = SupportSet(bases)
        self.view: SupportSet | None = None

    def add(self, q: FloatArray) -> None:
        if self.growing.add(q):
            self.view = copy.deepcopy(self.growing)
