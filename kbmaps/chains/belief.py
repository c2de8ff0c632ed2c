"""What is believed of a rigid chain: a Gaussian over the changes of a reference chain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, IntArray, frozen, rows, rows_or_vector
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.packed import CHAIN, chain_arrays, chain_from_arrays
from kbmaps.chains.parameters import WIDE, ChainParameters, ChainTolerances
from kbmaps.errors import NonFiniteError, SettingError, ShapeError
from kbmaps.packed import complete, number, pack, restoring, unpack

_KIND = "belief in a rigid chain, 2"
_BLOCK = 2048


@dataclass(frozen=True, eq=False)
class ChainBelief:
    """Mean and covariance of the parameters of a chain.

    Attributes:
        parameters: what they are, and the reference chain that they change.
        mean: (size,) [rad, m].
        root: matrix W (size, k) with the covariance W Wᵀ; a row of zeros holds its parameter.
        noise: 1-sigma of a coordinate of what was measured around the chain [m], as the pairs showed it; 0 where none
            did.

    Raises:
        ShapeError, NonFiniteError
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
        """The reference chain, as far as its tolerances let believe in it."""
        std = np.minimum(parameters.standard_deviations(tolerances), WIDE)
        return cls(parameters, np.zeros(parameters.size), np.diag(std))

    @classmethod
    def from_covariance(cls, parameters: ChainParameters, mean: FloatArray, covariance: FloatArray) -> Self:
        """A Gaussian with this covariance (size, size); a row of zeros holds its parameter.

        Scaled to correlations first: lengths and angles, known and unknown ones, differ by many orders of magnitude.
        """
        std = np.sqrt(np.diag(covariance))
        free = np.flatnonzero(std > 0.0)
        values, vectors = np.linalg.eigh(covariance[np.ix_(free, free)] / np.outer(std[free], std[free]))
        root = np.zeros((len(std), len(free)))
        root[free] = std[free, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        return cls(parameters, mean, root)

    @property
    def chain(self) -> RigidChain:
        """The most probable chain."""
        return self.parameters.chain(self.mean)

    @property
    def covariance(self) -> FloatArray:
        """Covariance (size, size) of the parameters [rad², m²]."""
        return self.root @ self.root.T

    def predict(self, q: ArrayLike) -> FloatArray:
        """Positions (n, 3) [m] of the most probable chain at q (n, d), or (3,) at q (d,).

        Raises:
            ShapeError, NonFiniteError
        """
        return self.parameters.positions(self.mean, rows_or_vector("q", q, self.parameters.reference.joints))

    def predict_with_variance(self, q: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Positions at q (n, d) and the variance of each coordinate to first order, both (n, 3) [m, m²].

        Raises:
            ShapeError, NonFiniteError
        """
        angles = rows("q", q, self.parameters.reference.joints)
        x, variance = np.empty((len(angles), 3)), np.empty((len(angles), 3))
        for start in range(0, len(angles), _BLOCK):
            part = slice(start, start + _BLOCK)
            x[part], jacobian = self.parameters.linearised(self.mean, angles[part])
            variance[part] = np.square(jacobian @ self.root).sum(axis=2)
        return x, variance

    def to_bytes(self) -> bytes:
        """The belief and its reference chain, as one self-describing byte string."""
        arrays = chain_arrays(self.parameters.reference) | {"mean": self.mean, "root": self.root}
        return pack(_KIND, {"noise": self.noise}, arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The belief in `data`. Raises ModelFormatError: it is none, or damaged."""
        fields, arrays = unpack(data, _KIND)
        with restoring("a belief in a chain"):
            complete(arrays, (*CHAIN, "mean", "root"))
            noise = number(fields["noise"], "the noise")
            return cls(ChainParameters(chain_from_arrays(arrays)), arrays["mean"], arrays["root"], noise)

    def tightened(self, before: ChainTolerances, after: ChainTolerances) -> tuple[Self, float]:
        """The same pairs' belief had it begun with narrower tolerances, and its evidence.

        Only what is narrower is exchanged; so what is believed may come from several tools, if that of the tool is not.
        Both are exact where positions are linear in the parameters.

        Args:
            before: the tolerances that the belief began with.
            after: those that it shall have begun with, none of them wider.

        Returns:
            The belief, and the logarithm of how many times as probable the narrower tolerances make the pairs.

        Raises:
            SettingError: a tolerance would be wider than it was, or held.
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

    def among(self, beliefs: Sequence[ChainBelief], shares: ArrayLike) -> Self:
        """This chain, as far as it may be any of several others: the mixture's second moment about this mean.

        Args:
            beliefs: in the same parameters; this one among them.
            shares: how probable each is (m,); they add up to 1.
        """
        weights = np.sqrt(np.asarray(shares, dtype=np.float64))
        apart = np.array([belief.mean - self.mean for belief in beliefs]).T * weights
        roots = [weight * belief.root for weight, belief in zip(weights, beliefs, strict=True)]
        free, triangle = squared(np.concatenate([*roots, apart], axis=1))
        root = np.zeros((len(self.mean), len(free)))
        root[free] = triangle
        return type(self)(self.parameters, self.mean, root, self.noise)

    def with_other_tool(self, tolerance: float) -> Self:
        """The same arm with a marker that was moved, by `tolerance` (1-sigma of each component [m]).

        Raises:
            SettingError: the tolerance is not positive.
        """
        if not (tolerance > 0.0 and math.isfinite(tolerance)):
            raise SettingError(f"tolerance must be finite and greater than 0 m, got {tolerance!r}")
        size = self.parameters.size
        return self.widened(np.arange(size)[self.parameters.tool], np.full(3, tolerance))

    def widened(self, columns: IntArray, std: FloatArray) -> Self:
        """The same chain but for some parameters that were changed, by `std` (k,) [rad, m] (1-sigma of each).

        Args:
            columns: which (k,).
        """
        changed = np.zeros((self.parameters.size, len(columns)))
        changed[columns, np.arange(len(columns))] = std
        free, root = squared(np.concatenate([self.root, changed], axis=1))
        full = np.zeros((self.parameters.size, self.parameters.size))
        full[np.ix_(free, free)] = root
        return type(self)(self.parameters, self.mean, full, self.noise)


def squared(root: FloatArray) -> tuple[IntArray, FloatArray]:
    """Which rows of a root (size, k) are free, as indices (f,), and their lower triangular root (f, f)."""
    free = np.flatnonzero(root.any(axis=1))
    held = root[free]
    if held.shape[1] < len(free):
        held = np.concatenate([held, np.zeros((len(free), len(free) - held.shape[1]))], axis=1)
    return free, cast(FloatArray, np.linalg.qr(held.T, mode="r")).T
