"""Common interface of all models of this package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self, runtime_checkable

from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray

SUPPORT_FACTOR = 2.0


@dataclass(frozen=True)
class Estimate:
    """Marker positions for a batch of configurations, or for one.

    A configuration is in support if the model is about as certain there as at its pairs: its variance, summed over the
    axes, is at most `SUPPORT_FACTOR` times the greatest at any of the learnt pairs, outliers left out. So all inliers
    are in support, and nothing is before the first pair, or the first since a tool change. A model with another rule
    documents it, with the reason, at its `estimate`.

    Attributes:
        x: positions (n, 3) [m]; (3,) for one configuration.
        sigma: their 1-sigma per axis against the truth, noise of measurements not included, likewise [m].
        in_support: True for each configuration near data (n,); () for one.
    """

    x: FloatArray
    sigma: FloatArray
    in_support: BoolArray

    def like(self, q: FloatArray) -> Estimate:
        """Return an estimate for a batch in the shape of q: unchanged for (n, d), the only row for q (d,)."""
        one = q.shape[:-1]
        return Estimate(self.x.reshape(*one, 3), self.sigma.reshape(*one, 3), self.in_support.reshape(one))


def near_data(variance: FloatArray, widest: float) -> BoolArray:
    """Return True for each configuration in support (n,), by the rule of `Estimate`.

    Args:
        variance: variance of each coordinate there (n, 3) [m²].
        widest: the result of `widest` for the learnt pairs [m²].
    """
    return variance.sum(axis=1) <= SUPPORT_FACTOR * widest


def widest(variance: FloatArray) -> float:
    """Return the greatest variance of a position [m²] among those of learnt pairs (n, 3); -1 without pairs."""
    return float(variance.sum(axis=1).max(initial=-1.0))


@runtime_checkable
class PositionModel(Protocol):
    """Map from joint values to positions, with its derivative: the input of inverse kinematics."""

    @property
    def joints(self) -> int:
        """Number of joints d."""
        ...

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return positions (n, 3) [m] at q (n, d) [rad, m], or (3,) at q (d,)."""
        ...

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Return their derivative (n, 3, d) [m/rad, or m/m], or (3, d) at q (d,)."""
        ...


@runtime_checkable
class PoseModel(PositionModel, Protocol):
    """Map from joint values to positions and orientations."""

    def orientation(self, q: ArrayLike, *, orthonormal: bool = False) -> FloatArray:
        """Return orientations (n, 3, 3), or (3, 3) at q (d,); with `orthonormal`, proper rotations."""
        ...

    def angular_jacobian(self, q: ArrayLike) -> FloatArray:
        """Return angular velocities (n, 3, d), or (3, d), of the orthonormal orientation, in the measurement frame."""
        ...


class Model(PositionModel, Protocol):
    """Forward kinematics model that learns from pairs.

    While the pairs so far do not determine the model, `predict`, `jacobian` and `estimate` raise DegenerateDataError.
    """

    @property
    def pairs(self) -> int:
        """Number of learnt pairs."""
        ...

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Learn pairs q (n, d) [rad, m] and x (n, 3) [m], or one, (d,) and (3,).

        Args:
            q: joint values.
            x: measured positions.
            sigma: 1-sigma of the positions [m], () or (n,); None if the model has to estimate it.

        Raises:
            ShapeError, NonFiniteError, SettingError (a sigma that is not positive): nothing has changed.
        """

    def estimate(self, q: ArrayLike) -> Estimate:
        """Return positions at q (n, d), or (d,), with their uncertainty."""
        ...

    def to_bytes(self) -> bytes:
        """Return the model with its learning state; `from_bytes` restores the same predictions to the last bit."""
        ...

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Return the model in `data`."""
        ...
