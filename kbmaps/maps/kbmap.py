"""Kinematic Bézier Map: forward kinematics that is linear in its control points."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, frozen, matching_rows, numbers, rows_or_vector, vector
from kbmaps.errors import BasisError, NonFiniteError, SettingError, ShapeError
from kbmaps.maps import serial
from kbmaps.maps.basis import JointBasis
from kbmaps.maps.code_path import NetKernel, net_kernel
from kbmaps.maps.stack import BasisStack
from kbmaps.rotations import nearest_rotation, nearest_rotation_rates, rotation_matrices

POSITION_OUTPUTS = 3
POSE_OUTPUTS = 12


@dataclass(frozen=True, eq=False)
class KBMap:
    """Position (and orientation, if learnt) of the marker in the measurement frame, of d joints.

    f(q) = Σ_i w_i(q) b_i with w = w_1(q_1) ⊗ … ⊗ w_d(q_d). Ulbrich et al. 2009, eqs. (10) and (15).

    Attributes:
        bases: one basis per joint, in the order of q.
        net: the coefficients as planes (outputs, m1, ..., md), m = 3 for a revolute joint and 2 for a prismatic one;
            control points [m] if the bases are Bernstein. Read-only. Outputs 0..2 are the position x, y, z [m];
            a map of 12 outputs continues with the columns e1, e2, e3 of the marker's rotation matrix.
        metadata: short texts stored with the map; not part of `digest`.

    Raises:
        ShapeError, NonFiniteError, BasisError

    Example:
        >>> import numpy as np
        >>> from kbmaps import JointBasis, RigidChain
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> kbmap = arm.to_kbmap([JointBasis.trigonometric()] * 2)
        >>> kbmap.net.shape, kbmap.predict([0.0, -np.pi / 2]).round(9)
        ((3, 3, 3), array([0.3, 0. , 0.2]))
    """

    bases: tuple[JointBasis, ...]
    net: FloatArray
    metadata: Mapping[str, str] = field(default_factory=dict[str, str])
    _stack: BasisStack = field(init=False, repr=False)
    _kernel: NetKernel = field(init=False, repr=False)

    def __post_init__(self) -> None:
        bases = tuple(self.bases)
        if not bases:
            raise BasisError("a map needs at least one joint")
        net = frozen(self.net)
        sizes = tuple(basis.size for basis in bases)
        if net.ndim != len(bases) + 1 or net.shape[1:] != sizes or net.shape[0] not in (POSITION_OUTPUTS, POSE_OUTPUTS):
            raise ShapeError("net", f"(3 or 12, {', '.join(map(str, sizes))})", net.shape)
        if not np.isfinite(net).all():
            raise NonFiniteError("net")
        stack = BasisStack(bases)
        object.__setattr__(self, "bases", bases)
        object.__setattr__(self, "net", net)
        object.__setattr__(self, "metadata", MappingProxyType(dict(self.metadata)))
        object.__setattr__(self, "_stack", stack)
        check_q = partial(rows_or_vector, "q", width=len(bases))
        check_x = partial(vector, "x", width=len(net))
        kernel = net_kernel(stack, net.reshape(-1, stack.right_size), check_q, check_x)
        object.__setattr__(self, "_kernel", kernel)

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return len(self.bases)

    @property
    def size(self) -> int:
        """Number of control points: 3^d for d revolute joints."""
        return math.prod(basis.size for basis in self.bases)

    @property
    def has_orientation(self) -> bool:
        return self.net.shape[0] == POSE_OUTPUTS

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return the marker position (3,) [m] for joint angles q (d,) [rad], or (n, 3) for (n, d)."""
        return self._kernel.outputs(q, 0, POSITION_OUTPUTS)

    def orientation(self, q: ArrayLike, *, orthonormal: bool = False) -> FloatArray:
        """Return the marker's axes e1, e2, e3 as columns of (3, 3), or (n, 3, 3).

        Args:
            q: joint angles (d,) or (n, d) [rad].
            orthonormal: return the nearest rotation; the learnt matrix is orthonormal only as far as it is exact.

        Raises:
            ShapeError: the map holds positions only, or q has the wrong length.
        """
        self._require_orientation()
        axes = _as_columns(self._kernel.outputs(q, POSITION_OUTPUTS, POSE_OUTPUTS))
        return nearest_rotation(axes) if orthonormal else axes

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the derivative (3, d) of the position [m/rad, or m/m], or (n, 3, d) for q (n, d)."""
        return self._kernel.derivatives(q, 0, POSITION_OUTPUTS)

    def angular_jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the angular velocity (3, d) of the orthonormal orientation R [rad/rad, or rad/m], or (n, 3, d).

        In the measurement frame: dR/dq_k = [column k]× R.

        Raises:
            ShapeError: the map holds positions only, or q has the wrong length.
        """
        self._require_orientation()
        checked = rows_or_vector("q", q, self.joints)
        axes = self._kernel.outputs(checked, POSITION_OUTPUTS, POSE_OUTPUTS)
        slopes = self._kernel.derivatives(checked, POSITION_OUTPUTS, POSE_OUTPUTS)
        turning = slopes.reshape(*checked.shape[:-1], 3, 3, self.joints).swapaxes(-3, -2)
        return nearest_rotation_rates(_as_columns(axes), turning)

    def weights(self, q: ArrayLike) -> FloatArray:
        """Return the full weight vector (3^d,) for q (d,), or (n, 3^d): the Kronecker product over the joints."""
        checked = rows_or_vector("q", q, self.joints)
        full = self._stack.full(np.atleast_2d(checked))
        return full[0] if checked.ndim == 1 else full

    def in_basis(self, bases: Sequence[JointBasis]) -> KBMap:
        """Return the same map with its net expressed in other bases; exact up to rounding.

        Raises:
            BasisError: wrong number of joints, or a prismatic basis for a revolute joint.
        """
        target = tuple(bases)
        if len(target) != self.joints:
            raise BasisError(f"need {self.joints} bases, one a joint; got {len(target)}")
        net = self.net
        for k, (old, new) in enumerate(zip(self.bases, target, strict=True)):
            if old != new:
                net = np.moveaxis(np.tensordot(old.change_to(new), net, axes=(1, k + 1)), 0, k + 1)
        return KBMap(target, net, self.metadata)

    def with_metadata(self, metadata: Mapping[str, str]) -> KBMap:
        """Return the same map with other metadata."""
        return KBMap(self.bases, self.net, metadata)

    def with_tool(self, marker_shift: ArrayLike) -> KBMap:
        """Return the map with its marker moved by δ (3,) [m] in the marker frame: G + E1 δ1 + E2 δ2 + E3 δ3.

        Raises:
            ShapeError: the map holds positions only, or δ has the wrong length.
        """
        self._require_orientation()
        shift = vector("marker_shift", marker_shift, 3)
        axes = self.net[POSITION_OUTPUTS:].reshape(3, POSITION_OUTPUTS, *self.net.shape[1:])
        net = self.net.copy()
        net[:POSITION_OUTPUTS] += np.einsum("a,a...->...", shift, axes)
        return KBMap(self.bases, net, self.metadata)

    def with_alpha(self, alpha: ArrayLike, centre: ArrayLike = 0.0) -> KBMap:
        """Return the same map with Bézier control points for another α; exact up to rounding.

        Args:
            alpha: α [rad], one for all revolute joints or one per joint (d,); prismatic joints keep their Bézier basis.
            centre: origin of −α and α [rad], likewise.

        Raises:
            BasisError: an α that is not within 0..180 degrees (SingularAlphaError: within 80..100).
        """
        alphas, centres = _one_a_joint("alpha", alpha, self.joints), _one_a_joint("centre", centre, self.joints)
        return self.in_basis(
            [
                basis.to_bernstein() if basis.is_prismatic else JointBasis.bernstein(a, c)
                for basis, a, c in zip(self.bases, alphas, centres, strict=True)
            ]
        )

    @classmethod
    def from_control_points(cls, bases: Sequence[JointBasis], points: ArrayLike) -> KBMap:
        """Return the map of Bézier control points (m1, ..., md, 3) [m], as in `control_points`.

        Args:
            bases: one per joint, Bernstein or prismatic.
            points: the control points (m1, ..., md, 3) [m].

        Raises:
            BasisError: a basis whose coefficients are not control points.
        """
        for k, basis in enumerate(bases):
            if basis.to_bernstein() != basis:
                raise BasisError(
                    f"joint {k + 1} has a {basis.kind} basis; control points need a Bernstein or prismatic one"
                )
        given = numbers("points", points)
        if given.ndim == 0 or given.shape[-1] != POSITION_OUTPUTS:
            raise ShapeError("points", f"(m1, ..., md, {POSITION_OUTPUTS})", given.shape)
        return cls(tuple(bases), np.moveaxis(given, -1, 0))

    @property
    def control_points(self) -> FloatArray:
        """Bézier control points (m1, ..., md, 3) [m], in the bases of `JointBasis.to_bernstein`.

        Use `with_alpha` first for other bases.
        """
        bernstein = self.in_basis([basis.to_bernstein() for basis in self.bases])
        return frozen(np.moveaxis(bernstein.net[:POSITION_OUTPUTS], 0, -1))

    @property
    def digest(self) -> str:
        """Sixteen hexadecimal digits that identify this map (bases and net)."""
        state = hashlib.blake2b(repr([(b.kind, b.parameters) for b in self.bases]).encode(), digest_size=8)
        state.update(self.net.astype("<f8", copy=False).tobytes())
        return state.hexdigest()

    def to_bytes(self) -> bytes:
        """Return the map as one self-describing byte string (see `kbmaps.maps.serial`)."""
        return serial.encode(self.bases, self.net, self.metadata)

    @classmethod
    def from_bytes(cls, data: bytes) -> KBMap:
        """Return the map in the bytes of `to_bytes`."""
        return cls(*serial.decode(data))

    def _require_orientation(self) -> None:
        if not self.has_orientation:
            raise ShapeError("net", f"({POSE_OUTPUTS}, ...) to give an orientation", self.net.shape)


def _as_columns(axes: FloatArray) -> FloatArray:
    """Return outputs (..., 9), three per unit vector, as matrices (..., 3, 3) with the unit vectors as columns."""
    return axes.reshape(*axes.shape[:-1], 3, 3).swapaxes(-1, -2)


def _one_a_joint(name: str, values: ArrayLike, joints: int) -> list[float]:
    given = numbers(name, values)
    if given.shape not in ((), (joints,)):
        raise ShapeError(name, f"() or ({joints},)", given.shape)
    if not np.isfinite(given).all():
        raise NonFiniteError(name)
    return np.broadcast_to(given, (joints,)).tolist()


def prediction_errors(kbmap: KBMap, q: ArrayLike, x: ArrayLike) -> FloatArray:
    """Return distances (n,) [m] between predicted and given positions x (n, 3) [m] at q (n, d) [rad].

    Example:
        >>> import numpy as np
        >>> from kbmaps import JointBasis, KBMap, prediction_errors
        >>> still = KBMap((JointBasis.trigonometric(),), np.zeros((3, 3)))
        >>> prediction_errors(still, [[0.0]], [[0.0, 0.3, 0.4]])
        array([0.5])
    """
    angles, positions = matching_rows(q, x, kbmap.joints)
    return np.linalg.norm(kbmap.predict(angles) - positions, axis=1)


def pose_targets(positions: FloatArray, rotation: ArrayLike | None, outputs: int) -> FloatArray:
    """Return outputs (n, 3 or 12) of a map for checked positions (n, 3) [m] and, if it has them, orientations.

    Args:
        positions: checked positions (n, 3) [m].
        rotation: (n, 3, 3), or unit quaternions x, y, z, w (n, 4); for one pair also (3, 3) or (4,).
        outputs: number of outputs of the map.

    Raises:
        SettingError: a rotation for a map of positions, or none for a map of poses.
    """
    if rotation is None:
        if outputs == POSE_OUTPUTS:
            raise SettingError("this map has an orientation, so every pair needs a rotation beside its position")
        return positions
    if outputs == POSITION_OUTPUTS:
        raise SettingError("this map has positions alone; to learn orientations begin with a map that has them")
    matrices = rotation_matrices("rotation", rotation).reshape(-1, 3, 3)
    if len(matrices) != len(positions):
        raise ShapeError("rotation", f"({len(positions)}, 3, 3) or ({len(positions)}, 4) to go with x", matrices.shape)
    return np.concatenate([positions, matrices.swapaxes(1, 2).reshape(-1, 9)], axis=1)
