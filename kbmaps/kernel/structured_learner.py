"""Learner of a nominal chain with a linear prior from its tolerances, and a KB-Map for non-rigid deviations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, frozen, rows_or_vector
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import (
    CHAIN,
    WIDE,
    ChainParameters,
    ChainTolerances,
    chain_arrays,
    chain_from_arrays,
    describe_tolerances,
    parse_tolerances,
)
from kbmaps.kernel.kept_pairs import KeptPairs
from kbmaps.kernel.kernel_fit import KernelFit
from kbmaps.kernel.regression import KernelRegression
from kbmaps.maps.basis import JointBasis, check_bases, describe_bases, parse_bases
from kbmaps.memory import Memory, describe_memory, parse_memory
from kbmaps.model import Estimate, near_data, widest
from kbmaps.packed import complete, count, named, pack, restoring, unpack

_KIND = "structured learner, 2"


class StructuredLearner(KernelRegression):
    """Learns f(q) = f_nominal(q) + J(q) β + r(q), linear in the unknowns. A `Model`.

    J is the derivative of the nominal chain by its parameters. β has the variances S of the tolerances, so that J β has
    the covariance J S Jᵀ. r is a KB-Map around zero whose scale the evidence chooses. For given scales the posterior is
    in closed form, without local optima, and a KB-Map, since every column of J is one. It neglects the curvature of a
    chain far from nominal, which r absorbs where there are pairs. The fit runs on first use after `learn`, with the
    pairs that the memory keeps.

    Args:
        nominal: the nominal chain.
        tolerances: standard deviations of the real chain about it.
        bases: of r; scaled orthonormal ones (`learning_bases`) are advised.
        memory: the old pairs that count.

    Raises:
        BasisError: the number or the kinds of bases do not match the joints.
    """

    def __init__(
        self,
        nominal: RigidChain,
        tolerances: ChainTolerances,
        bases: Sequence[JointBasis],
        *,
        memory: Memory | None = None,
    ) -> None:
        check_bases(bases, nominal.prismatic.tolist())
        super().__init__(bases, "evidence", memory)
        self._nominal = nominal
        self._tolerances = tolerances
        self._widest: tuple[KernelFit, float] | None = None
        self._parameters = ChainParameters(nominal)
        std = np.minimum(self._parameters.standard_deviations(tolerances), WIDE)
        self._free = np.flatnonzero(std)
        self._std = std[self._free]

    @property
    def nominal(self) -> RigidChain:
        """Chain that learning started from."""
        return self._nominal

    @property
    def change(self) -> FloatArray:
        """Most probable parameters (size,) as in `ChainParameters`, to first order (read-only)."""
        change = np.zeros(self._parameters.size)
        if self.kept:
            change[self._free] = self._std * self._fitted().change
        return frozen(change)

    @property
    def residual_std(self) -> float:
        """Standard deviation of the control points of r [m]. Raises DegenerateDataError."""
        return math.sqrt(self._fitted().prior_variance)

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        """Learn pairs q (n, d) [rad, m] and x (n, 3) [m], or one, (d,) and (3,); see `Model.learn`."""
        self._pairs.add(*self._pairs.checked(q, x, sigma), self._nominal)
        self._fit = None

    def estimate(self, q: ArrayLike) -> Estimate:
        """Return positions at q (n, d), or (d,), 1-sigma per axis against the truth, True where data is near."""
        angles = rows_or_vector("q", q, self.joints)
        batch = np.atleast_2d(angles)
        x, features = self._behind(batch)
        if not self.kept:
            unknown = Estimate(x, np.sqrt(np.square(features).sum(axis=2)), np.zeros(len(x), dtype=np.bool_))
            return unknown.like(angles)
        fit, weights = self._fitted(), self._kernel.joint_weights(batch)
        variance = fit.variance(weights, features)
        if self._widest is None or self._widest[0] is not fit:
            self._widest = fit, widest(fit.variance(self._kernel.joint_weights(self._pairs.q), self._features()))
        inside = near_data(variance, self._widest[1])
        return Estimate(x + fit.mean(weights, features), np.sqrt(variance), inside).like(angles)

    def to_bytes(self) -> bytes:
        """Return the learner with the pairs that count; `from_bytes` restores the same predictions to the last bit."""
        fields: dict[str, Any] = {
            "bases": describe_bases(self.bases),
            "tolerances": describe_tolerances(self._tolerances),
            "memory": describe_memory(self._memory),
            "pairs": self.pairs,
        }
        return pack(_KIND, fields, self._pairs.arrays() | chain_arrays(self.nominal))

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Return the learner in `data`. Raises ModelFormatError: wrong type of model, or damaged."""
        fields, arrays = unpack(data, _KIND)
        with restoring("a structured learner"):
            named(fields, "the fields", ("bases", "tolerances", "memory", "pairs"))
            complete(arrays, (*CHAIN, *KeptPairs.STORED))
            bases, memory = parse_bases(fields["bases"]), parse_memory(fields["memory"])
            learner = cls(chain_from_arrays(arrays), parse_tolerances(fields["tolerances"]), bases, memory=memory)
            learner._pairs.restore(arrays, count(fields["pairs"], "the number of pairs"))
        return learner

    def _behind(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return nominal positions (n, 3) and the columns of J times their tolerances (n, 3, p)."""
        x, jacobian = self._parameters.linearised(np.zeros(self._parameters.size), q)
        return x, jacobian[:, :, self._free] * self._std
