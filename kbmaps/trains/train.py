"""Forward kinematics as a tensor train: one affine core per joint instead of 3^d control points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, frozen, rows_or_vector
from kbmaps.chains.chain import RigidChain
from kbmaps.errors import BasisError, NonFiniteError, SettingError, ShapeError
from kbmaps.maps.basis import JointBasis, check_bases, check_net_size, describe_bases, parse_bases
from kbmaps.maps.kbmap import POSITION_OUTPUTS, KBMap
from kbmaps.maps.stack import BasisStack
from kbmaps.packed import complete, count, flag, named, pack, restoring, unpack

KIND = "tensor train"


@dataclass(frozen=True, eq=False)
class TensorTrain:
    """Marker positions as a product of affine maps, one per joint.

    M_k(q_k) = Σ_j w_kj(q_k) B_kj with B_kj the upper three rows of an affine 4x4 matrix, and x(q) = M_1(q_1) ∘ … ∘
    M_d(q_d) applied to the origin. The control net of this map is a tensor train (Oseledets 2011) of rank 4. Every
    rigid chain is one, and so is every chain whose joints move on ellipses.

    Attributes:
        bases: one basis per joint, in the order of q.
        cores: B (d, 3, 3, 4): joint, basis function, row, column; the last column of a core is a translation [m].
            A prismatic joint has two functions, its third slice is 0. The first three columns of the last core
            move no position. Read-only.

    Raises:
        ShapeError, NonFiniteError, BasisError

    Example:
        >>> import numpy as np
        >>> from kbmaps import RigidChain, TensorTrain, learning_bases
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> train = TensorTrain.from_chain(arm, learning_bases([-1, -1], [1, 1]))
        >>> bool(np.allclose(train.predict([0.0, -np.pi / 2]), [0.3, 0.0, 0.2], atol=1e-9))
        True
    """

    bases: tuple[JointBasis, ...]
    cores: FloatArray
    _stack: BasisStack = field(init=False, repr=False)

    def __post_init__(self) -> None:
        bases, cores = tuple(self.bases), frozen(self.cores)
        if not bases:
            raise BasisError("a tensor train needs at least one joint")
        if cores.shape != (len(bases), 3, 3, 4):
            raise ShapeError("cores", f"({len(bases)}, 3, 3, 4)", cores.shape)
        if not np.isfinite(cores).all():
            raise NonFiniteError("cores")
        for k, basis in enumerate(bases):
            if cores[k, basis.size :].any():
                raise BasisError(f"joint {k + 1} is prismatic: the third slice of its core must be 0")
        object.__setattr__(self, "bases", bases)
        object.__setattr__(self, "cores", cores)
        object.__setattr__(self, "_stack", BasisStack(bases))

    @classmethod
    def from_chain(cls, chain: RigidChain, bases: Sequence[JointBasis]) -> TensorTrain:
        """Return the chain as a tensor train, exact up to rounding.

        Raises:
            BasisError: wrong number of bases, or a revolute basis for a prismatic joint.
        """
        check_bases(bases, chain.prismatic.tolist())
        cores = np.zeros((chain.joints, 3, 3, 4))
        for k, basis in enumerate(bases):
            last = chain.fixed[k + 1] if k == chain.joints - 1 else np.eye(4)
            link = RigidChain(np.stack([chain.fixed[k], last]), chain.axes[k : k + 1], chain.prismatic[k : k + 1])
            # monomials = weights @ inv(matrix), so Σ_i monomial_i A_i = Σ_j weight_j Σ_i inv(matrix)_ji A_i
            cores[k, : basis.size] = np.tensordot(
                np.linalg.inv(basis.matrix), _monomial_terms(link)[:, :3], axes=(1, 0)
            )
        return cls(tuple(bases), cores)

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return len(self.bases)

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return the marker position (3,) [m] for joint values q (d,) [rad, m], or (n, 3) for (n, d)."""
        checked = rows_or_vector("q", q, self.joints)
        positions = suffixes(self.maps(np.atleast_2d(checked)))[0]
        return positions[0] if checked.ndim == 1 else positions

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the derivative (3, d) of the position [m/rad, or m/m], or (n, 3, d) for q (n, d)."""
        checked = rows_or_vector("q", q, self.joints)
        angles = np.atleast_2d(checked)
        maps = self.maps(angles)
        slopes = _mixed(self._stack.joint_derivatives(angles), self.cores)
        linear, points = prefixes(maps), suffixes(maps)
        columns = np.empty((len(angles), 3, self.joints))
        for k in range(self.joints):
            columns[:, :, k] = (linear[k] @ apply(slopes[k], points[k + 1])[:, :, None])[:, :, 0]
        return columns[0] if checked.ndim == 1 else columns

    def in_basis(self, bases: Sequence[JointBasis]) -> TensorTrain:
        """Return the same map with its cores expressed in other bases; exact up to rounding.

        Raises:
            BasisError: wrong number of joints, or a prismatic basis for a revolute joint.
        """
        if len(bases) != self.joints:
            raise BasisError(f"need {self.joints} bases, one a joint; got {len(bases)}")
        cores = np.zeros_like(self.cores)
        for k, (old, new) in enumerate(zip(self.bases, bases, strict=True)):
            cores[k, : new.size] = np.tensordot(old.change_to(new), self.cores[k, : old.size], axes=(1, 0))
        return TensorTrain(tuple(bases), cores)

    def to_kbmap(self) -> KBMap:
        """Return the same map with its full control net: 3^d control points, so for few joints only.

        Raises:
            NetSizeError: more than 3^13 control points.
        """
        check_net_size(self.bases, POSITION_OUTPUTS)
        tensor: FloatArray = np.array([0.0, 0.0, 0.0, 1.0])
        for k in range(self.joints - 1, -1, -1):
            size = self.bases[k].size
            block = np.zeros((4, size, 4))
            block[:3] = self.cores[k, :size].swapaxes(0, 1)
            # The last row is 1 for every q: the coefficients of the constant function.
            block[3, :, 3] = np.linalg.solve(self.bases[k].matrix, np.eye(size)[0])
            tensor = np.tensordot(block, tensor, axes=(2, 0)).astype(np.float64, copy=False)
        return KBMap(self.bases, tensor[:3])

    def maps(self, q: FloatArray) -> FloatArray:
        """Return the affine maps M_k(q_k) as (d, n, 3, 4) for q (n, d), which is not checked."""
        return _mixed(self._stack.joint_weights(q), self.cores)

    def to_bytes(self) -> bytes:
        """Return the map as one self-describing byte string (see `kbmaps.packed`)."""
        return pack(KIND, {"bases": describe_bases(self.bases)}, {"cores": self.cores})

    @classmethod
    def from_bytes(cls, data: bytes) -> TensorTrain:
        """Return the map in the bytes of `to_bytes`."""
        fields, arrays = unpack(data, KIND)
        with restoring("a tensor train"):
            complete(arrays, ("cores",))
            return cls(parse_bases(named(fields, "the fields", ("bases",))["bases"]), arrays["cores"])


def apply(maps: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (n, 3) moved by affine maps (n, 3, 4)."""
    return (maps[:, :, :3] @ points[:, :, None])[:, :, 0] + maps[:, :, 3]


def suffixes(maps: FloatArray) -> FloatArray:
    """Return, for affine maps (d, n, 3, 4), the marker (d+1, n, 3) seen before each joint; the last is the origin."""
    points = np.zeros((len(maps) + 1, maps.shape[1], 3))
    for k in range(len(maps) - 1, -1, -1):
        points[k] = apply(maps[k], points[k + 1])
    return points


def prefixes(maps: FloatArray) -> FloatArray:
    """Return, for affine maps (d, n, 3, 4), the linear part (d, n, 3, 3) of the product of maps before each joint."""
    linear = np.empty((len(maps), maps.shape[1], 3, 3))
    linear[0] = np.eye(3)
    for k in range(1, len(maps)):
        linear[k] = linear[k - 1] @ maps[k - 1][:, :, :3]
    return linear


def _mixed(weights: FloatArray, cores: FloatArray) -> FloatArray:
    """Return Σ_j weights[:, k, j] cores[k, j] for weights (n, d, 3): (d, n, 3, 4)."""
    flat = weights.swapaxes(0, 1) @ cores.reshape(len(cores), 3, 12)
    return flat.reshape(*flat.shape[:2], 3, 4)


def _monomial_terms(link: RigidChain) -> FloatArray:
    """Return A (3 or 2, 4, 4) of a one-joint chain: T = A0 + cos q·A1 + sin q·A2, or A0 + q·A1 if prismatic."""
    if link.prismatic[0]:
        start, end = link.poses([[0.0], [1.0]])
        return np.stack([start, end - start])
    start, quarter, half = link.poses([[0.0], [0.5 * np.pi], [np.pi]])
    middle = 0.5 * (start + half)
    return np.stack([middle, 0.5 * (start - half), quarter - middle])


@dataclass(frozen=True)
class TensorSettings:
    """Settings of a TensorLearner.

    Attributes:
        window: number of the last pairs to keep; None keeps all.
        refit_every: number of new pairs after which `learn` refits; earlier if they are a quarter of all kept pairs.
            Until then, or until `refit`, they wait.
        robust: leave out pairs that lie more than five robust standard deviations off.
        starts: maximum number of random chains to start from without a prior.
        seed: of these random chains, so that the same pairs give the same train.

    Raises:
        SettingError: window, refit_every or starts below 1, seed below 0.
    """

    window: int | None = None
    refit_every: int = 25
    robust: bool = True
    starts: int = 12
    seed: int = 0

    def __post_init__(self) -> None:
        lower = {"window": 1 if self.window is None else self.window, "refit_every": self.refit_every}
        for name, value in {**lower, "starts": self.starts}.items():
            if value < 1:
                raise SettingError(f"{name} must be at least 1, got {value}")
        if self.seed < 0:
            raise SettingError(f"seed must be at least 0, got {self.seed}")


def parse_settings(value: Any) -> TensorSettings:
    """Return the settings from `dataclasses.asdict`.

    Raises:
        ModelFormatError, SettingError: it does not describe one.
    """
    stored = named(value, "the settings", [field.name for field in fields(TensorSettings)])
    whole = {name: count(stored[name], f"the setting {name}") for name in ("refit_every", "starts", "seed")}
    window = None if stored["window"] is None else count(stored["window"], "the setting window")
    return TensorSettings(window, robust=flag(stored["robust"], "the setting robust"), **whole)
