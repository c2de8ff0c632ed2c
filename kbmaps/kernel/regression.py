"""Common base of learners through the product kernel: kept pairs, fitted on demand."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, rows_or_vector
from kbmaps.chains.carried import Predictor
from kbmaps.errors import DegenerateDataError
from kbmaps.kernel.kept_pairs import KeptPairs
from kbmaps.kernel.kernel_fit import KernelFit, Precision
from kbmaps.kernel.product_kernel import ProductKernel
from kbmaps.maps.basis import JointBasis, check_net_size
from kbmaps.maps.kbmap import POSITION_OUTPUTS, KBMap
from kbmaps.memory import Memory

_THIRD_OF_A_TURN = 2.0 * math.pi / 3.0


def sampled_map(model: Predictor, bases: Sequence[JointBasis]) -> KBMap:
    """Return the KB-Map in these bases that agrees with a model at 3^d configurations (2 for each prismatic joint).

    If the model is a KB-Map in another form, such as a rigid chain or a kernel learner around one, they agree
    everywhere.

    Raises:
        NetSizeError: more than 3^13 control points.
        BasisError, and errors of the model for joint values outside its domain.
    """
    check_net_size(bases, POSITION_OUTPUTS)
    nodes = [_nodes(basis) for basis in bases]
    grid = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, len(nodes))
    net = model.predict(grid).T.reshape(3, *(len(values) for values in nodes))
    for k, (basis, values) in enumerate(zip(bases, nodes, strict=True)):
        solved = np.linalg.inv(basis.weights(values))
        net = np.moveaxis(np.tensordot(solved, net, axes=(1, k + 1)), 0, k + 1)
    return KBMap(tuple(bases), net)


def _nodes(basis: JointBasis) -> FloatArray:
    """Return values at which the basis functions differ well: the ends of the range and the middle [rad, m]."""
    if basis.is_prismatic:
        return np.array(basis.parameters[:2])
    if basis.kind == "orthonormal":
        low, high, _ = basis.parameters
        centre, reach = 0.5 * (low + high), 0.5 * (high - low)
    elif basis.kind == "bernstein":
        reach, centre = basis.parameters
    else:
        centre, reach = 0.0, _THIRD_OF_A_TURN
    return centre + min(reach, _THIRD_OF_A_TURN) * np.array([-1.0, 0.0, 1.0])


# Large enough that rounding costs only two digits, small enough for a map that is not exactly of this form.
_STEP = 1e-2


def slopes(model: Predictor, q: ArrayLike, bases: Sequence[JointBasis]) -> FloatArray:
    """Return the derivative (3, d) [m/rad, or m/m] of a model's positions at q (d,), or (n, 3, d) at q (n, d).

    f(θ + h) − f(θ − h) = 2 sin h f'(θ) for any f = a + b cos θ + c sin θ and any h. So this is exact for KB-Maps in any
    form; likewise with 2 h for a prismatic joint.
    """
    angles = rows_or_vector("q", q, len(bases))
    steps = _STEP * np.eye(len(bases))
    flat = angles.reshape(-1, 1, len(bases))
    ahead, behind = (model.predict((flat + way * steps).reshape(-1, len(bases))) for way in (1.0, -1.0))
    lengths = np.array([2.0 * (_STEP if basis.is_prismatic else math.sin(_STEP)) for basis in bases])
    columns = (ahead - behind).reshape(len(flat), len(bases), 3) / lengths[:, None]
    return columns.swapaxes(1, 2).reshape(*angles.shape[:-1], 3, len(bases))


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
        """Return positions (n, 3) [m] at q (n, d), or (3,) at q (d,)."""
        angles = rows_or_vector("q", q, self.joints)
        x, features = self._behind(np.atleast_2d(angles))
        if self.kept:
            x = x + self._fitted().mean(self._kernel.joint_weights(np.atleast_2d(angles)), features)
        return x[0] if angles.ndim == 1 else x

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the derivative (3, d) of the position [m/rad, or m/m], or (n, 3, d) at q (n, d).

        Exact if the prior model is a KB-Map, also in another form such as a chain.
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
