"""A nominal chain whose tolerances are a linear prior, and a KB-Map for what is not rigid about the arm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, frozen, rows, rows_or_vector
from kbmaps.chains.carried import ChainModel, packable, unpacked
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import WIDE, ChainParameters, ChainTolerances
from kbmaps.errors import BasisError, DegenerateDataError, KBMapsError, ModelFormatError
from kbmaps.kernel.grid import sampled_map
from kbmaps.kernel.kept_pairs import KeptPairs
from kbmaps.kernel.kernel_fit import KernelFit
from kbmaps.kernel.product_kernel import ProductKernel
from kbmaps.kernel.slopes import slopes
from kbmaps.maps.basis import JointBasis
from kbmaps.maps.kbmap import KBMap
from kbmaps.maps.packed import describe_bases, parse_bases
from kbmaps.memory import Memory
from kbmaps.model import Estimate
from kbmaps.packed import named, numbers, pack, unpack

_KIND = "structured learner, 1"
# A configuration lies where data was while what is left open is at most the noise of a pair (in variance).
_LARGEST_LEVERAGE = 1.0


class StructuredLearner:
    """f(q) = f_nominal(q) + J(q) β + r(q), linear in what is learnt. A `Model`.

    J is the derivative of the nominal chain by its parameters and β has the variances S of the tolerances, so that J β
    has the covariance J S Jᵀ; r is a KB-Map around zero whose scale the evidence chooses. For given scales the
    posterior is in closed form, without local optima, and a KB-Map, since every column of J is one. What it misses of a
    far-off chain is the curvature, which r makes up for where pairs are. Fitted when first asked after `learn`,
    from the pairs that the memory keeps.

    Args:
        nominal: the chain as drawn.
        tolerances: how far the real one may be from it.
        bases: of r; scaled orthonormal ones (`learning_bases`) are advised.
        memory: which of the old pairs count.

    Raises:
        BasisError: another number of bases than joints.
    """

    def __init__(
        self,
        nominal: RigidChain,
        tolerances: ChainTolerances,
        bases: Sequence[JointBasis],
        *,
        memory: Memory | None = None,
    ) -> None:
        if len(bases) != nominal.joints:
            raise BasisError(f"need {nominal.joints} bases, one a joint; got {len(bases)}")
        self._kernel = ProductKernel(bases)
        self._nominal = ChainModel(nominal)
        self._tolerances = tolerances
        self._memory = Memory() if memory is None else memory
        self._parameters = ChainParameters(nominal)
        std = np.minimum(self._parameters.standard_deviations(tolerances), WIDE)
        self._free = np.flatnonzero(std)
        self._std = std[self._free]
        self._pairs = KeptPairs(self.joints, self._memory)
        self._fit: KernelFit | None = None

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return self._kernel.joints

    @property
    def pairs(self) -> int:
        """How many pairs have been learnt, those that no longer count included."""
        return self._pairs.total

    @property
    def kept(self) -> int:
        """How many pairs count."""
        return len(self._pairs)

    @property
    def nominal(self) -> RigidChain:
        """The chain that learning started from."""
        return self._nominal.chain

    @property
    def change(self) -> FloatArray:
        """The most probable parameters (size,) as in `ChainParameters`, to first order (read-only)."""
        change = np.zeros(self._parameters.size)
        if self.kept:
            change[self._free] = self._std * self._fitted().change
        return frozen(change)

    @property
    def noise(self) -> float:
        """1-sigma of a measured coordinate [m]: as estimated, or as told with the pairs.

        Raises:
            DegenerateDataError: no pair has been learnt.
        """
        return math.sqrt(self._fitted().noise_variance) * self._pairs.mean_unit

    @property
    def residual_std(self) -> float:
        """Standard deviation of the control points of r [m]. Raises DegenerateDataError."""
        return math.sqrt(self._fitted().prior_variance)

    @property
    def log_evidence(self) -> float | None:
        """Log marginal likelihood of the pairs. Raises DegenerateDataError."""
        return self._fitted().log_evidence

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Pairs q (n, d) [rad, m] and x (n, 3) [m], or one, (d,) and (3,).

        Args:
            sigma: 1-sigma of the positions [m], () or (n,); None where it is to be estimated.

        Raises:
            ShapeError, NonFiniteError, SettingError (a sigma that is not positive): nothing has changed.
        """
        self._pairs.add(*self._pairs.checked(q, x, sigma), self._nominal)
        self._fit = None

    def predict(self, q: ArrayLike) -> FloatArray:
        """Positions (n, 3) [m] at q (n, d), or (3,) at q (d,).

        Raises:
            ShapeError, NonFiniteError
        """
        angles = rows_or_vector("q", q, self.joints)
        x, features = self._linearised(np.atleast_2d(angles))
        if self.kept:
            x = x + self._fitted().mean(self._kernel.joint_weights(np.atleast_2d(angles)), features)
        return x[0] if angles.ndim == 1 else x

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Derivative (3, d) of the position [m/rad, or m/m], or (n, 3, d) at q (n, d).

        Raises:
            ShapeError, NonFiniteError
        """
        return slopes(self, q, self._kernel.bases)

    def estimate(self, q: ArrayLike) -> Estimate:
        """Positions at q (n, d), their 1-sigma per axis against the truth, and whether data was there.

        Raises:
            ShapeError, NonFiniteError
        """
        angles = rows("q", q, self.joints)
        x, features = self._linearised(angles)
        if not self.kept:
            return Estimate(x, np.sqrt(np.square(features).sum(axis=2)), np.zeros(len(x), dtype=np.bool_))
        fit, weights = self._fitted(), self._kernel.joint_weights(angles)
        variance = fit.variance(weights, features)
        inside = variance.mean(axis=1) <= _LARGEST_LEVERAGE * self.noise**2
        return Estimate(x + fit.mean(weights, features), np.sqrt(variance), inside)

    def to_kbmap(self) -> KBMap:
        """The learnt map with its 3^d control points."""
        return sampled_map(self, self._kernel.bases)

    def to_bytes(self) -> bytes:
        """The learner with the pairs that count; `from_bytes` gives the same predictions to the last bit."""
        behind, arrays = packable(self._nominal)
        fields: dict[str, Any] = {
            "bases": describe_bases(self._kernel.bases),
            "tolerances": asdict(self._tolerances),
            "memory": asdict(self._memory),
            "pairs": self.pairs,
            "nominal": behind,
        }
        return pack(_KIND, fields, self._pairs.arrays() | arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The learner in `data`. Raises ModelFormatError: it is none of this kind, or damaged."""
        fields, arrays = unpack(data, _KIND)
        try:
            tolerances = numbers(named(fields["tolerances"], "the tolerances", tuple(asdict(ChainTolerances()))))
            nominal = unpacked(fields["nominal"], arrays, None)
            bases, memory = parse_bases(fields["bases"]), Memory(**fields["memory"])
            learner = cls(nominal.chain, ChainTolerances(**tolerances), bases, memory=memory)
            learner._pairs.restore(arrays, int(fields["pairs"]))
        except ModelFormatError:
            raise
        except (AttributeError, KeyError, TypeError, ValueError, KBMapsError) as error:
            raise ModelFormatError(f"the bytes do not describe a structured learner: {error}") from error
        return learner

    def _linearised(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Nominal positions (n, 3) and the columns of J times their tolerances (n, 3, p)."""
        x, jacobian = self._parameters.linearised(np.zeros(self._parameters.size), q)
        return x, jacobian[:, :, self._free] * self._std

    def _fitted(self) -> KernelFit:
        if not self.kept:
            raise DegenerateDataError("there is nothing to tell before the first pair was learnt")
        if self._fit is None:
            _, features = self._linearised(self._pairs.q)
            observations = self._pairs.observations(self._kernel, features)
            self._fit = KernelFit(self._kernel, observations, "evidence")
        return self._fit
