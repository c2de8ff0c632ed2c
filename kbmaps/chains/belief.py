"""Gaussian posterior over the parameters of a rigid chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, IntArray, batches, frozen, require_positive, rows, rows_or_vector
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import CHAIN, WIDE, ChainParameters, ChainTolerances, chain_arrays, chain_from_arrays
from kbmaps.errors import NonFiniteError, SettingError, ShapeError
from kbmaps.packed import complete, number, pack, restoring, unpack

_KIND = "belief in a rigid chain, 2"


@dataclass(frozen=True, eq=False)
class ChainBelief:
    """Mean and covariance of the parameters of a chain.

    Attributes:
        parameters: the parametrisation, with its reference chain.
        mean: (size,) [rad, m].
        root: matrix W (size, k) with the covariance W Wᵀ; a row of zeros holds its parameter.
        noise: 1-sigma of a measured coordinate about the chain [m], estimated from pairs; 0 without pairs.

    Raises:
        SettingError: a noise below 0.
    """

    parameters: ChainParameters
    mean: FloatArray
    root: FloatArray
    noise: float = 0.0

    def __post_init__(self) -> None:
        size = self.parameters.size
        if self.mean.shape != (size,):
            raise ShapeError("mean", f"({size},)", self.mean.shape)
        if self.root.ndim != 2 or len(self.root) != size:
            raise ShapeError("root", f"({size}, k)", self.root.shape)
        for name in ("mean", "root"):
            if not np.isfinite(getattr(self, name)).all():
                raise NonFiniteError(name)
            object.__setattr__(self, name, frozen(getattr(self, name)))
        if not 0.0 <= self.noise < np.inf:
            raise SettingError(f"noise must be finite and not negative, got {self.noise!r}")

    @classmethod
    def from_tolerances(cls, parameters: ChainParameters, tolerances: ChainTolerances) -> Self:
        """Return the reference chain with its tolerances as the prior."""
        std = np.minimum(parameters.standard_deviations(tolerances), WIDE)
        return cls(parameters, np.zeros(parameters.size), np.diag(std))

    @classmethod
    def from_covariance(cls, parameters: ChainParameters, mean: FloatArray, covariance: FloatArray) -> Self:
        """Return a Gaussian with this covariance (size, size); a row of zeros holds its parameter.

        The covariance is first scaled to correlations: lengths and angles, known and unknown ones, differ by many
        orders of magnitude.
        """
        std = np.sqrt(np.diag(covariance))
        free = np.flatnonzero(std > 0.0)
        values, vectors = np.linalg.eigh(covariance[np.ix_(free, free)] / np.outer(std[free], std[free]))
        root = np.zeros((len(std), len(free)))
        root[free] = std[free, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        return cls(parameters, mean, root)

    @property
    def chain(self) -> RigidChain:
        """Most probable chain."""
        return self.parameters.chain(self.mean)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (size, size) of the parameters [rad², m²]."""
        return self.root @ self.root.T

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return the positions (n, 3) [m] of the most probable chain at q (n, d), or (3,) at q (d,)."""
        return self.parameters.positions(self.mean, rows_or_vector("q", q, self.parameters.reference.joints))

    def predict_with_variance(self, q: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return positions at q (n, d) and the first-order variance of each coordinate, both (n, 3) [m, m²]."""
        angles = rows("q", q, self.parameters.reference.joints)
        x, variance = np.empty((len(angles), 3)), np.empty((len(angles), 3))
        for part in batches(len(angles)):
            x[part], jacobian = self.parameters.linearised(self.mean, angles[part])
            variance[part] = np.square(jacobian @ self.root).sum(axis=2)
        return x, variance

    def to_bytes(self) -> bytes:
        """Return the belief and its reference chain as one self-describing byte string."""
        arrays = chain_arrays(self.parameters.reference) | {"mean": self.mean, "root": self.root}
        return pack(_KIND, {"noise": self.noise}, arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Return the belief in `data`."""
        fields, arrays = unpack(data, _KIND)
        with restoring("a belief in a chain"):
            complete(arrays, (*CHAIN, "mean", "root"))
            noise = number(fields["noise"], "the noise")
            return cls(ChainParameters(chain_from_arrays(arrays)), arrays["mean"], arrays["root"], noise)

    def tightened(self, before: ChainTolerances, after: ChainTolerances) -> tuple[Self, float]:
        """Return the posterior that narrower tolerances would have given for the same pairs, and its evidence.

        Only the tolerances that change are exchanged. So the posterior may combine pairs of several tools, provided
        that the tool's tolerance does not change. Both results are exact where positions are linear in the parameters.

        Args:
            before: the tolerances of the original prior.
            after: the tolerances to use instead, none of them wider.

        Returns:
            The posterior, and the log Bayes factor of the narrower tolerances against the original ones.

        Raises:
            SettingError: a tolerance would become wider, or 0.
        """
        wide, narrow = (np.minimum(self.parameters.standard_deviations(each), WIDE) for each in (before, after))
        if (narrow > wide).any() or ((narrow == 0.0) & (wide > 0.0)).any():
            raise SettingError("tolerances can only be made narrower, and not 0")
        free = np.flatnonzero(narrow < wide)
        added = np.zeros(self.parameters.size)
        added[free] = narrow[free] ** -2.0 - wide[free] ** -2.0
        # C' = (C⁻¹ + D)⁻¹ with C = W Wᵀ is W (1 + Wᵀ D W)⁻¹ Wᵀ, and C'⁻¹ m' = C⁻¹ m gives m' = m - C' D m.
        factor = np.linalg.cholesky(np.eye(self.root.shape[1]) + (self.root.T * added) @ self.root)
        root = cast(FloatArray, np.linalg.solve(factor, self.root.T)).T
        mean = self.mean - root @ (root.T @ (added * self.mean))
        evidence = float(np.log(wide[free] / narrow[free]).sum() - np.log(np.diag(factor)).sum())
        return type(self)(self.parameters, mean, root, self.noise), evidence - 0.5 * float(self.mean @ (added * mean))

    def with_mixture_covariance(self, beliefs: Sequence[ChainBelief], shares: ArrayLike) -> Self:
        """Return this chain with the uncertainty of a mixture: the mixture's second moment about this mean.

        Args:
            beliefs: the components, in the same parameters; this one among them.
            shares: their probabilities (m,), which add up to 1.
        """
        weights = np.sqrt(np.asarray(shares, dtype=np.float64))
        apart = np.array([belief.mean - self.mean for belief in beliefs]).T * weights
        roots = [weight * belief.root for weight, belief in zip(weights, beliefs, strict=True)]
        free, triangle = squared(np.concatenate([*roots, apart], axis=1))
        root = np.zeros((len(self.mean), len(free)))
        root[free] = triangle
        return type(self)(self.parameters, self.mean, root, self.noise)

    def with_other_tool(self, tolerance: float) -> Self:
        """Return the same arm with a marker displaced by `tolerance` (1-sigma of each component [m]).

        Raises:
            SettingError: the tolerance is not positive.
        """
        require_positive("tolerance", tolerance, unit=" m")
        size = self.parameters.size
        return self.widened(np.arange(size)[self.parameters.tool], np.full(3, tolerance))

    def widened(self, columns: IntArray, std: FloatArray) -> Self:
        """Return the same chain with the uncertainty of some parameters increased by `std` (k,) [rad, m] (1-sigma).

        Args:
            columns: indices (k,) of these parameters.
            std: 1-sigma of each change (k,) [rad, m].
        """
        changed = np.zeros((self.parameters.size, len(columns)))
        changed[columns, np.arange(len(columns))] = std
        free, root = squared(np.concatenate([self.root, changed], axis=1))
        full = np.zeros((self.parameters.size, self.parameters.size))
        full[np.ix_(free, free)] = root
        return type(self)(self.parameters, self.mean, full, self.noise)


def squared(root: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the indices (f,) of the free rows of a root (size, k), and their lower triangular root (f, f)."""
    free = np.flatnonzero(root.any(axis=1))
    held = root[free]
    if held.shape[1] < len(free):
        held = np.concatenate([held, np.zeros((len(free), len(free) - held.shape[1]))], axis=1)
    return free, cast(FloatArray, np.linalg.qr(held.T, mode="r")).T
