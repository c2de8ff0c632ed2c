"""What every model of this package can do, so that one can stand in for another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self, runtime_checkable

from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray

SUPPORT_FACTOR = 2.0


@dataclass(frozen=True)
class Estimate:
    """Marker positions for a batch of configurations, or for one.

    A configuration is in support where the pairs speak of it about as they do of themselves: its variance, summed over
    the axes, is at most `SUPPORT_FACTOR` times the greatest at any of the learnt pairs, outliers left out. So all of
    these are in support, and nothing is before the first pair, or the first since a tool change. A model for which this
    cannot be the law says so, and why, at its `estimate`.

    Attributes:
        x: positions (n, 3) [m]; (3,) for one configuration.
        sigma: their 1-sigma per axis against the truth, noise of measurements not included, likewise [m].
        in_support: whether each lies where data was (n,); () for one.
    """

    x: FloatArray
    sigma: FloatArray
    in_support: BoolArray

    def like(self, q: FloatArray) -> Estimate:
        """An estimate for a batch as that for q: (n, d) leaves it, for q (d,) it is that of the only row."""
        one = q.shape[:-1]
        return Estimate(self.x.reshape(*one, 3), self.sigma.reshape(*one, 3), self.in_support.reshape(one))


def near_data(variance: FloatArray, widest: float) -> BoolArray:
    """Whether configurations are in support (n,), by the law of `Estimate`.

    Args:
        variance: of each coordinate there (n, 3) [m²].
        widest: what `widest` gives for the learnt pairs [m²].
    """
    return variance.sum(axis=1) <= SUPPORT_FACTOR * widest


def widest(variance: FloatArray) -> float:
    """The greatest variance of a position [m²] among those of learnt pairs (n, 3); -1, below all, without any."""
    return float(variance.sum(axis=1).max(initial=-1.0))


@runtime_checkable
class PositionModel(Protocol):
    """A map from joint values to positions, with its derivative: what inverse kinematics needs."""

    @property
    def joints(self) -> int:
        """Number of joints d."""
        ...

    def predict(self, q: ArrayLike) -> FloatArray:
        """Positions (n, 3) [m] at q (n, d) [rad, m], or (3,) at q (d,)."""
        ...

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Their derivative (n, 3, d) [m/rad, or m/m], or (3, d) at q (d,)."""
        ...


@runtime_checkable
class PoseModel(PositionModel, Protocol):
    """A map that has the orientation too."""

    def orientation(self, q: ArrayLike, *, orthonormal: bool = False) -> FloatArray:
        """Orientations (n, 3, 3), or (3, 3) at q (d,); with `orthonormal`, proper rotations."""
        ...

    def angular_jacobian(self, q: ArrayLike) -> FloatArray:
        """Angular velocities (n, 3, d), or (3, d), of the orthonormal orientation, in the measurement frame."""
        ...


class Model(PositionModel, Protocol):
    """A model of a forward kinematics that learns from pairs.

    While the pairs so far determine none, `predict`, `jacobian` and `estimate` raise DegenerateDataError.
    """

    @property
    def pairs(self) -> int:
        """How many pairs have been learnt."""
        ...

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Pairs q (n, d) [rad, m] and x (n, 3) [m], or one, (d,) and (3,).

        Args:
            sigma: 1-sigma of the positions [m], () or (n,); None where the model has to find it out.

        Raises:
            ShapeError, NonFiniteError, SettingError (a sigma that is not positive): nothing has changed.
        """
        ...

    def estimate(self, q: ArrayLike) -> Estimate:
        """Positions at q (n, d), or (d,), with their uncertainty."""
        ...

    def to_bytes(self) -> bytes:
        """The model and all that it needs to learn on, as one self-describing byte string."""
        ...

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The model in `data`. Raises ModelFormatError: it is none of this kind, or damaged."""
        ...
