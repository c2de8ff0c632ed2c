"""Common base of learners through the product kernel: kept pairs, fitted on demand."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, rows_or_vector
from kbmaps.errors import DegenerateDataError
from kbmaps.kernel.grid import sampled_map
from kbmaps.kernel.kept_pairs import KeptPairs
from kbmaps.kernel.kernel_fit import KernelFit, Precision
from kbmaps.kernel.product_kernel import ProductKernel
from kbmaps.kernel.slopes import slopes
from kbmaps.maps.basis import JointBasis
from kbmaps.maps.kbmap import KBMap
from kbmaps.memory import Memory


class KernelRegression(ABC):
    """Prior model, a linear change of it, and a KB-Map for the rest, fitted to the pairs that the memory keeps.

    Args:
        bases: of the KB-Map.
        precision: λ of it, see `KernelLearner`.
        memory: the old pairs that count; all of them if None.
    """

    def __init__(self, bases: Sequence[JointBasis], precision: Precision, memory: Memory | None) -> None:
        self._kernel = ProductKernel(bases)
        self._precision: Precision = precision
        self._memory = Memory() if memory is None else memory
        self._pairs = KeptPairs(self.joints, self._memory)
        self._fit: KernelFit | None = None

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return self._kernel.joints

    @property
    def bases(self) -> tuple[JointBasis, ...]:
        return self._kernel.bases

    @property
    def pairs(self) -> int:
        """Number of learnt pairs, those that no longer count included."""
        return self._pairs.total

    @property
    def kept(self) -> int:
        """Number of pairs that count."""
        return len(self._pairs)

    @property
    def noise(self) -> float:
        """Noise of a measured coordinate, 1-sigma [m]: estimated, or given with the pairs.

        Raises:
            DegenerateDataError: no pair has been learnt.
        """
        return math.sqrt(self._fitted().noise_variance) * self._pairs.mean_unit

    @property
    def log_evidence(self) -> float | None:
        """Log marginal likelihood of the pairs; None for the exact solution. Raises DegenerateDataError."""
        return self._fitted().log_evidence

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return positions (n, 3) [m] at q (n, d), or (3,) at q (d,).

        Raises:
            ShapeError, NonFiniteError
        """
        angles = rows_or_vector("q", q, self.joints)
        x, features = self._behind(np.atleast_2d(angles))
        if self.kept:
            x = x + self._fitted().mean(self._kernel.joint_weights(np.atleast_2d(angles)), features)
        return x[0] if angles.ndim == 1 else x

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the derivative (3, d) of the position [m/rad, or m/m], or (n, 3, d) at q (n, d).

        Exact if the prior model is a KB-Map, also in another form such as a chain.

        Raises:
            ShapeError, NonFiniteError
        """
        return slopes(self, q, self.bases)

    def to_kbmap(self) -> KBMap:
        """Return the learnt map with its 3^d control points, exact if the prior model is a KB-Map or a rigid chain.

        Raises:
            NetSizeError: more than 3^13 control points.
        """
        return sampled_map(self, self.bases)

    @abstractmethod
    def _behind(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions (n, 3) of the prior model at q (n, d), and the columns (n, 3, p) of its linear change."""

    def _features(self) -> FloatArray:
        """Return those columns at the kept pairs."""
        return self._behind(self._pairs.q)[1]

    def _fitted(self) -> KernelFit:
        if not self.kept:
            raise DegenerateDataError("there is nothing to tell before the first pair was learnt")
        if self._fit is None:
            observations = self._pairs.observations(self._kernel, self._features())
            self._fit = KernelFit(self._kernel, observations, self._precision)
        return self._fit
