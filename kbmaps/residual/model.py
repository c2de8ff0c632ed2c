"""Rigid chain with learnt deviations: an immutable map from joint values to positions."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Self, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, IntArray, batches, frozen, require_positive, rows, rows_or_vector
from kbmaps.chains.belief import ChainBelief
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import CHAIN, ChainParameters, chain_arrays, chain_from_arrays
from kbmaps.errors import NonFiniteError, SettingError, ShapeError
from kbmaps.packed import complete, named, numbers, pack, restoring, unpack
from kbmaps.residual.features import ResidualFeatures, ResidualScaling

_KIND = "rigid chain with residual, fitted, 2"
_SCALING = ("middle", "half", "centre", "load")
_GROUP = "group "


class _Settings:
    # lumped loads on linear springs are accurate to a few per cent of the deflection that they explain
    law_error = 0.03
    # Fourth-order differences [rad, m]: truncation and rounding errors are both about 1e-13 of the derivative.
    slope_step = 1e-3


_STENCIL = np.array([-2.0, -1.0, 1.0, 2.0])
_SLOPES = np.array([1.0, -8.0, 8.0, -1.0]) / 12.0


@dataclass(frozen=True, eq=False)
class ResidualModel:
    """Gaussian over a chain and the weights of the groups of deviations that the pairs support.

    The result of `ResidualLearner`, without its pairs. It can be the prior of another learner.

    Attributes:
        features: the chain's parameters and the groups' functions.
        change: most probable change of the chain's parameters (size,) [rad, m].
        weights: most probable weights of each group (features,).
        root: W (size + features of all groups, k) with the covariance W Wᵀ of the change, then the weights.
        noise: 1-sigma of a measured coordinate [m], estimated from pairs; 0 without pairs.

    Raises:
        SettingError: the noise is negative or not finite, or there is no such group.
    """

    features: ResidualFeatures
    change: FloatArray
    weights: Mapping[str, FloatArray]
    root: FloatArray
    noise: float = 0.0

    def __post_init__(self) -> None:
        parameters = self.features.parameters
        object.__setattr__(self, "weights", MappingProxyType({g: frozen(w) for g, w in self.weights.items()}))
        if strange := set(self.weights) - set(self.features.groups()):
            raise SettingError(f"this arm has no groups {', '.join(sorted(strange))}")
        if len(self.features.scaling.middle) != self.joints:
            raise ShapeError("middle", f"({self.joints},)", self.features.scaling.middle.shape)
        arrays = {"change": (self.change, parameters.size)}
        arrays |= {group: (weights, self.features.size(group)) for group, weights in self.weights.items()}
        for name, (array, size) in arrays.items():
            if array.shape != (size,):
                raise ShapeError(name, f"({size},)", array.shape)
        total = sum(size for _, size in arrays.values())
        if self.root.ndim != 2 or len(self.root) != total:
            raise ShapeError("root", f"({total}, k)", self.root.shape)
        for name, array in (("root", self.root), *((name, array) for name, (array, _) in arrays.items())):
            if not np.isfinite(array).all():
                raise NonFiniteError(name)
        if not 0.0 <= self.noise < math.inf:
            raise SettingError(f"noise must be finite and not negative, got {self.noise!r}")
        object.__setattr__(self, "change", frozen(self.change))
        object.__setattr__(self, "root", frozen(self.root))

    @classmethod
    def of_belief(cls, belief: ChainBelief, scaling: ResidualScaling | None = None, noise: float = 0.0) -> Self:
        """Return a rigid chain without deviations."""
        scaling = scaling or ResidualScaling.whole_turns(belief.parameters.reference.joints)
        return cls(ResidualFeatures(belief.parameters, scaling), belief.mean, {}, belief.root, noise)

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return self.features.joints

    @cached_property
    def chain(self) -> RigidChain:
        """Rigid part of the model."""
        return self.features.parameters.chain(self.change)

    @property
    def mean(self) -> FloatArray:
        """Change, then the weights."""
        return np.concatenate([self.change, *self.weights.values()])

    @property
    def belief(self) -> ChainBelief:
        """Posterior of the rigid part, with the deviations marginalised."""
        parameters = self.features.parameters
        return ChainBelief(parameters, self.change, self.root[: parameters.size], self.noise)

    @property
    def digest(self) -> str:
        """Sixteen hexadecimal digits that identify this map, without its uncertainty."""
        arrays = self._arrays()
        del arrays["root"]
        return hashlib.blake2b(pack(_KIND, {"scale": self.features.scaling.scale}, arrays), digest_size=8).hexdigest()

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return positions (n, 3) [m] at q (n, d) [rad, m], or (3,) at q (d,)."""
        angles = rows_or_vector("q", q, self.joints)
        x = self.features.positions(self.chain, self.weights, np.atleast_2d(angles))
        return x[0] if angles.ndim == 1 else x

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the derivative (n, 3, d) of the positions [m/rad, or m/m], or (3, d) at q (d,)."""
        angles = rows_or_vector("q", q, self.joints)
        if not self.weights:
            return self.chain.jacobian(angles)
        steps = _Settings.slope_step * _STENCIL[:, None] * np.eye(self.joints)[:, None]
        around = np.atleast_2d(angles)[:, None, None] + steps
        x = self.features.positions(self.chain, self.weights, around.reshape(-1, self.joints))
        x = x.reshape(*around.shape[:3], 3)
        slopes = np.einsum("njsi,s->nij", x, _SLOPES / _Settings.slope_step)
        return slopes[0] if angles.ndim == 1 else slopes

    def predict_with_variance(self, q: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return positions at q (n, d) and the first-order variance of each coordinate, both (n, 3) [m, m²]."""
        angles = rows("q", q, self.joints)
        x, variance = np.empty((len(angles), 3)), np.empty((len(angles), 3))
        for part in batches(len(angles)):
            point = self.features.linearised(self.change, self.chain, self.weights, angles[part], tuple(self.weights))
            design = np.concatenate([point.chain, *point.groups.values()], axis=2)
            x[part], variance[part] = point.x, np.square(design @ self.root).sum(axis=2)
            for group in self.features.approximate(self.weights):
                move = point.groups[group] @ self.weights[group]
                variance[part] += _Settings.law_error**2 / 3.0 * np.square(move).sum(axis=1, keepdims=True)
        return x, variance

    def effects(self, q: ArrayLike) -> dict[str, float]:
        """Return each group's motion of the positions at q (n, d), RMS of the distances [m]; 0 for no q."""
        angles = rows("q", q, self.joints)
        point = self.features.linearised(self.change, self.chain, self.weights, angles, tuple(self.weights))
        moves = {group: point.groups[group] @ weights for group, weights in self.weights.items()}
        return {group: math.sqrt(float(np.square(move).sum()) / max(len(move), 1)) for group, move in moves.items()}

    def with_other_tool(self, tolerance: float) -> Self:
        """Return the same arm with a marker displaced by `tolerance` (1-sigma of each component [m]).

        The joints' compliance and errors stay unchanged; the hand's load stays in its place.

        Raises:
            SettingError: the tolerance is not positive.
        """
        require_positive("tolerance", tolerance, unit=" m")
        parameters, scaling = self.features.parameters, self.features.scaling
        widened = self.widened(np.arange(parameters.size)[parameters.tool], np.full(3, tolerance))
        if scaling.load is None:
            scaling = replace(scaling, load=self.chain.fixed[-1, :3, 3])
        return replace(widened, features=ResidualFeatures(parameters, scaling))

    def widened(self, columns: IntArray, std: FloatArray) -> Self:
        """Return the same arm with the uncertainty of some chain parameters increased.

        Args:
            columns: indices (k,) of these parameters.
            std: 1-sigma of each change (k,) [rad, m].
        """
        changed = np.zeros((len(self.root), len(columns)))
        changed[columns, np.arange(len(columns))] = std
        root = cast(FloatArray, np.linalg.qr(np.concatenate([self.root, changed], axis=1).T, mode="r")).T
        return replace(self, root=root)

    def to_bytes(self) -> bytes:
        """Return the model as one self-describing byte string.

        `from_bytes` restores the same predictions to the last bit.
        """
        return pack(_KIND, {"scale": self.features.scaling.scale, "noise": self.noise}, self._arrays())

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Return the model in `data`."""
        fields, arrays = unpack(data, _KIND)
        with restoring("a rigid chain with residual"):
            settings = numbers(named(fields, "the fields", ("scale", "noise")))
            groups = [name for name in arrays if name.startswith(_GROUP)]
            complete(arrays, (*CHAIN, *_SCALING, "change", "root", *groups))
            middle, half, centre, load = (arrays[name] for name in _SCALING)
            scaling = ResidualScaling(middle, half, centre, settings["scale"], load if len(load) else None)
            features = ResidualFeatures(ChainParameters(chain_from_arrays(arrays)), scaling)
            weights = {name.removeprefix(_GROUP): arrays[name] for name in groups}
            return cls(features, arrays["change"], weights, arrays["root"], settings["noise"])

    def _arrays(self) -> dict[str, FloatArray]:
        scaling = self.features.scaling
        arrays = chain_arrays(self.features.parameters.reference) | {
            "middle": scaling.middle,
            "half": scaling.half,
            "centre": scaling.centre,
            "load": np.empty(0) if scaling.load is None else scaling.load,
            "change": self.change,
            "root": self.root,
        }
        return arrays | {_GROUP + group: weights for group, weights in self.weights.items()}
