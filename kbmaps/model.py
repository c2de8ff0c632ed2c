"""What every model of this package can do, so that one can stand in for another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class Estimate:
    """Marker positions for a batch of configurations.

    Attributes:
        x: positions (n, 3) [m].
        sigma: their 1-sigma per axis against the truth, noise of measurements not included (n, 3) [m].
        in_support: whether each lies where data was (n,).
    """

    x: FloatArray
    sigma: FloatArray
    in_support: BoolArray


class Model(Protocol):
    """A model of a forward kinematics that learns from pairs.

    While the pairs so far determine none, `predict` and `estimate` raise DegenerateDataError.
    """

    @property
    def joints(self) -> int:
        """Number of joints d."""
        ...

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

    def predict(self, q: ArrayLike) -> FloatArray:
        """Positions (n, 3) [m] at q (n, d), or (3,) at q (d,)."""
        ...

    def estimate(self, q: ArrayLike) -> Estimate:
        """Positions at q (n, d) with their uncertainty."""
        ...

    def to_bytes(self) -> bytes:
        """The model and all that it needs to learn on, as one self-describing byte string."""
        ...

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The model in `data`. Raises ModelFormatError: it is none of this kind, or damaged."""
        ...
