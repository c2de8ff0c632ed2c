"""Rigid serial chains: the nominal model that learning starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, frozen, numbers, rows_or_vector, vector
from kbmaps.errors import ChainError, NonFiniteError, ShapeError
from kbmaps.maps.basis import JointBasis, check_bases, check_net_size
from kbmaps.maps.kbmap import POSE_OUTPUTS, POSITION_OUTPUTS, KBMap
from kbmaps.rotations import cross_matrix, nearest_rotation

_RIGID_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class RigidChain:
    """Serial chain from the measurement frame to the marker frame.

    T(q) = F_0 · J_1(q_1) · F_1 · J_2(q_2) · … · J_d(q_d) · F_d, where J_k rotates about (or, prismatic, translates
    along) its axis. The marker is the origin of the last frame.

    Attributes:
        fixed: the constant transforms F_0 ... F_d (d+1, 4, 4), lengths [m].
        axes: unit axes (d, 3) in each joint's own frame, the frame after F_{k-1}.
        prismatic: True for each prismatic joint (d,).

    Raises:
        ChainError: a transform is not rigid or an axis is not of unit length.

    Example:
        >>> import numpy as np
        >>> from kbmaps import RigidChain
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> arm.positions([0.0, -np.pi / 2]).round(9)
        array([0.3, 0. , 0.2])
    """

    fixed: FloatArray
    axes: FloatArray
    prismatic: BoolArray

    def __post_init__(self) -> None:
        fixed, axes = frozen(self.fixed), frozen(self.axes)
        prismatic = np.array(self.prismatic, dtype=np.bool_)
        prismatic.flags.writeable = False
        if axes.ndim != 2 or axes.shape[1] != 3 or len(axes) == 0:
            raise ShapeError("axes", "(d, 3) with d of at least 1", axes.shape)
        if fixed.shape != (len(axes) + 1, 4, 4):
            raise ShapeError("fixed", f"({len(axes) + 1}, 4, 4)", fixed.shape)
        if prismatic.shape != (len(axes),):
            raise ShapeError("prismatic", f"({len(axes)},)", prismatic.shape)
        for name, array in (("fixed", fixed), ("axes", axes)):
            if not np.isfinite(array).all():
                raise NonFiniteError(name)
        for k in np.flatnonzero(~_are_rigid(fixed)).tolist():
            check_rigid(f"fixed[{k}]", fixed[k])
        lengths = np.linalg.norm(axes, axis=1)
        if np.abs(lengths - 1.0).max() > _RIGID_TOLERANCE:
            worst = int(np.abs(lengths - 1.0).argmax())
            raise ChainError(f"axes[{worst}] has length {lengths[worst]:.6g}; axes must be unit vectors")
        object.__setattr__(self, "fixed", fixed)
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "prismatic", prismatic)

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return len(self.axes)

    def poses(self, q: ArrayLike) -> FloatArray:
        """Return the pose of the marker frame (4, 4) for q (d,) [rad, m]; (n, 4, 4) for (n, d).

        In the measurement frame.
        """
        checked = rows_or_vector("q", q, self.joints)
        return self._frames(checked)[-1]

    def positions(self, q: ArrayLike) -> FloatArray:
        """Return the marker position (3,) [m] for q (d,), or (n, 3) for (n, d)."""
        return self.poses(q)[..., :3, 3]

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return `positions(q)`, under the name that all models share."""
        return self.positions(q)

    def orientation(self, q: ArrayLike, *, orthonormal: bool = False) -> FloatArray:
        """Return the rotation (3, 3) of the marker frame in the measurement frame for q (d,), or (n, 3, 3) for (n, d).

        Args:
            q: joint values (d,) or (n, d) [rad, m].
            orthonormal: remove the rounding errors of the fixed transforms, at most 1e-6 each.
        """
        rotations = self.poses(q)[..., :3, :3]
        return nearest_rotation(rotations) if orthonormal else rotations

    def frames(self, q: ArrayLike) -> FloatArray:
        """Return the poses of joints 1..d before they move and of the marker: (d+1, 4, 4) for q (d,).

        All are in the measurement frame. For q (n, d): (n, d+1, 4, 4).
        """
        checked = rows_or_vector("q", q, self.joints)
        return self._frames_of_rows(checked) if checked.ndim == 2 else np.stack(self._frames(checked), axis=-3)

    def jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the derivative (3, d) of the position [m/rad, or m/m], or (n, 3, d) for q (n, d)."""
        checked = rows_or_vector("q", q, self.joints)
        frames = self._frames(checked)
        marker = frames[-1][..., :3, 3]
        columns = np.empty((*checked.shape[:-1], 3, self.joints))
        for k, frame in enumerate(frames[:-1]):
            axis = frame[..., :3, :3] @ self.axes[k]
            lever = marker - frame[..., :3, 3]
            columns[..., k] = axis if self.prismatic[k] else np.cross(axis, lever)
        return columns

    def angular_jacobian(self, q: ArrayLike) -> FloatArray:
        """Return the angular velocity (3, d) of the marker frame [rad/rad, or rad/m], or (n, 3, d) for q (n, d).

        In the measurement frame: dR/dq_k = [column k]× R.
        """
        checked = rows_or_vector("q", q, self.joints)
        columns = np.zeros((*checked.shape[:-1], 3, self.joints))
        for k, frame in enumerate(self._frames(checked)[:-1]):
            if not self.prismatic[k]:
                columns[..., k] = frame[..., :3, :3] @ self.axes[k]
        return columns

    def to_kbmap(self, bases: Sequence[JointBasis], *, orientation: bool = False) -> KBMap:
        """Convert the chain to a KB-Map, exact up to rounding, without any sampling.

        Each joint's 4x4 matrix is affine in its basis functions. The product of the chain is therefore a tensor product
        of them, and its last column is the control net.

        Args:
            bases: one per joint.
            orientation: add the nine planes of the rotation matrix.

        Raises:
            BasisError: wrong number of bases, or a revolute basis for a prismatic joint.
            NetSizeError: more than 3^13 control points.
        """
        check_net_size(bases, POSE_OUTPUTS if orientation else POSITION_OUTPUTS)
        net = self._net(bases, 3)
        return KBMap(tuple(bases), np.concatenate([net, self.orientation_maps(bases)]) if orientation else net)

    def orientation_maps(self, bases: Sequence[JointBasis]) -> FloatArray:
        """Return the planes (9, m1, ..., md) of the unit vectors e1, e2, e3 of the marker frame (three planes each).

        A tool displaced by δ [m] in the marker frame is exactly G + E1 δ1 + E2 δ2 + E3 δ3.

        Raises:
            BasisError: wrong number of bases, or a revolute basis for a prismatic joint.
            NetSizeError: more than 3^13 control points.
        """
        check_net_size(bases, POSE_OUTPUTS - POSITION_OUTPUTS)
        return np.concatenate([self._net(bases, column) for column in range(3)])

    def with_tool(self, marker_shift: ArrayLike) -> RigidChain:
        """Return the chain with its marker displaced by a vector (3,) [m] given in the marker frame."""
        fixed = self.fixed.copy()
        fixed[-1, :3, 3] += fixed[-1, :3, :3] @ vector("marker_shift", marker_shift, 3)
        return RigidChain(fixed, self.axes, self.prismatic)

    def transformed(self, T_new_old: ArrayLike) -> RigidChain:
        """Return the chain in another measurement frame, in which the old one has the pose T_new_old (4, 4).

        Raises:
            ChainError: not a rigid transform.
        """
        transform = numbers("T_new_old", T_new_old)
        check_rigid("T_new_old", transform)
        fixed = self.fixed.copy()
        fixed[0] = transform @ fixed[0]
        return RigidChain(fixed, self.axes, self.prismatic)

    def _frames(self, q: FloatArray) -> list[FloatArray]:
        """Return the frames of joints 1..d (before they move), then the marker frame, each (..., 4, 4)."""
        constant, first, second = self._moved_links
        pose = np.broadcast_to(self.fixed[0], (*q.shape[:-1], 4, 4))
        cosines = np.where(self.prismatic, q, np.cos(q))[..., None, None]
        links = constant + cosines * first + np.sin(q)[..., None, None] * second
        frames = [pose]
        for k in range(self.joints):
            pose = pose @ links[..., k, :, :]
            frames.append(pose)
        return frames

    def _frames_of_rows(self, q: FloatArray) -> FloatArray:
        """Return `_frames` (n, d+1, 4, 4) for many q (n, d), several times as fast: one operation per matrix entry."""
        constant, first, second = self._moved_links[..., None]
        cosines, sines = np.where(self.prismatic, q, np.cos(q)).T.copy(), np.sin(q).T.copy()
        frames = np.zeros((self.joints + 1, 4, 4, len(q)))
        frames[0] = self.fixed[0][:, :, None]
        frames[:, 3, 3] = 1.0
        for k in range(self.joints):
            link = constant[k] + cosines[k] * first[k] + sines[k] * second[k]
            np.einsum("ijn,jkn->ikn", frames[k, :3], link, out=frames[k + 1, :3])
        return np.ascontiguousarray(frames.transpose(3, 0, 1, 2))

    @cached_property
    def _moved_links(self) -> FloatArray:
        """Matrices (3, d, 4, 4) of J_k(q) F_k for every joint, in the terms of `_joint_terms`."""
        terms = np.stack([self._joint_terms(k) for k in range(self.joints)], axis=1)
        return frozen(terms @ self.fixed[1:])

    def _joint_terms(self, k: int) -> FloatArray:
        """Return matrices A (3, 4, 4): J_k(q) = A0 + cos q·A1 + sin q·A2 (Rodrigues), or A0 + q·A1 if prismatic."""
        axis = self.axes[k]
        terms = np.zeros((3, 4, 4))
        if self.prismatic[k]:
            terms[0] = np.eye(4)
            terms[1, :3, 3] = axis
            return terms
        along = np.outer(axis, axis)
        terms[0, :3, :3], terms[0, 3, 3] = along, 1.0
        terms[1, :3, :3] = np.eye(3) - along
        terms[2, :3, :3] = cross_matrix(axis)
        return terms

    def _net(self, bases: Sequence[JointBasis], column: int) -> FloatArray:
        """Return the coefficients (3, m1, ..., md) of the upper part of one column of T(q)."""
        check_bases(bases, self.prismatic.tolist())
        tensor: FloatArray = self.fixed[-1][:, column]
        for k in range(self.joints - 1, -1, -1):
            basis = bases[k]
            # monomials = weights @ inv(matrix), so Σ_i monomial_i A_i = Σ_j weight_j Σ_i inv(matrix)_ji A_i
            terms = self._joint_terms(k)[: basis.size]
            by_weight = np.einsum("ji,irc->rjc", np.linalg.inv(basis.matrix), self.fixed[k] @ terms)
            tensor = np.tensordot(by_weight, tensor, axes=(2, 0)).astype(np.float64, copy=False)
        return tensor[:3]


def check_rigid(name: str, transform: FloatArray) -> None:
    """Raise ShapeError or ChainError unless `transform` (4, 4) is a proper rigid transform."""
    if transform.shape != (4, 4):
        raise ShapeError(name, "(4, 4)", transform.shape)
    if not _are_rigid(transform[None])[0]:
        raise ChainError(f"{name} is not a rigid transform: a proper rotation, a translation and the row 0 0 0 1")


def _are_rigid(transforms: FloatArray) -> BoolArray:
    rotations = transforms[:, :3, :3]
    off = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    is_proper = (off <= _RIGID_TOLERANCE) & (np.linalg.det(rotations) > 0.0)
    return is_proper & (transforms[:, 3] == (0.0, 0.0, 0.0, 1.0)).all(axis=1)
