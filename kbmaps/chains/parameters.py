"""Deviations of a rigid chain from its nominal form as one vector, and their effect on the marker."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, IntArray, frozen, rows_or_vector, vector
from kbmaps.chains.chain import RigidChain
from kbmaps.errors import ModelFormatError, SettingError
from kbmaps.maps.code_path import FilterKernel, filter_kernel
from kbmaps.packed import named, or_infinite, unless_infinite
from kbmaps.rotations import RotationSettings, cross_matrix, exponentials

# Finite stand-in for an infinite tolerance [rad, m]: far beyond anything real, and still a proper prior.
WIDE = 10.0
_FIXED_PARAMETERS = 9
_JOINT_PARAMETERS = 5
_EYE = np.eye(3)


@dataclass(frozen=True, eq=False)
class ChainTolerances:
    """Standard deviations of each component of a real arm about its nominal chain.

    Zero holds a parameter at its nominal value; infinity leaves it to the data alone.

    Attributes:
        axes: tilt of a joint's axis [rad].
        points: shift of a joint's axis across itself [m].
        zeros: joint offset of a revolute joint [rad].
        slide_zeros: joint offset of a prismatic joint [m].
        tool: position of the marker [m].
        base_rotation: turn of the whole arm about the origin of the measurement frame [rad].
        base_translation: shift of the whole arm in the measurement frame [m].

    Raises:
        SettingError: one is negative or NaN.

    Example:
        >>> from kbmaps import ChainTolerances
        >>> ChainTolerances(zeros=0.05, tool=0.03).axes  # unnamed components are held at nominal
        0.0
    """

    axes: float = 0.0
    points: float = 0.0
    zeros: float = 0.0
    slide_zeros: float = 0.0
    tool: float = 0.0
    base_rotation: float = 0.0
    base_translation: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not value >= 0.0:
                raise SettingError(f"the tolerance {name} must be 0 or greater (infinity included), got {value!r}")
            object.__setattr__(self, name, float(value))


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Chain after a change, at q = 0 and before the base motion."""

    base: FloatArray
    base_turns: FloatArray
    axes: FloatArray
    points: FloatArray
    tilt_turns: FloatArray
    rotations: FloatArray
    zeros: FloatArray
    tip: FloatArray


class ChainParameters:
    """Small changes of a reference chain, as vectors (size,), and the resulting marker positions.

    The product of exponentials of screws given with all joints at zero (Brockett 1984): a change of one axis leaves the
    others unchanged. In this order, with d joints:

        base turn (3) [rad]  rotation vector of the arm about the origin of the measurement frame
        base shift (3) [m]   translation of the arm in the measurement frame, after the rotation
        tilts (2 d) [rad]    of each axis, about two directions across it
        shifts (2 d) [m]     of each axis, along the same two directions; without effect for a prismatic joint
        zeros (d) [rad, m]   joint offsets, added to the joints' readings
        tool (3) [m]         displacement of the marker in the marker frame

    Rotations of an axis about itself and shifts along itself would change nothing and are left out. The rest is
    over-complete on purpose: axes and tool can compensate for base and joint offsets, and only a prior separates them.

    Example:
        >>> import numpy as np
        >>> from kbmaps import ChainParameters, RigidChain
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> parameters = ChainParameters(arm)
        >>> change = np.zeros(parameters.size)
        >>> change[parameters.zeros] = 0.0, -np.pi / 2
        >>> parameters.positions(change, [0.0, 0.0]).round(9)
        array([0.3, 0. , 0.2])
    """

    def __init__(self, reference: RigidChain) -> None:
        d = reference.joints
        self.reference = reference
        self.size = _FIXED_PARAMETERS + _JOINT_PARAMETERS * d
        self.base_turn, self.base_shift = slice(0, 3), slice(3, 6)
        self.tilts, self.shifts = slice(6, 6 + 2 * d), slice(6 + 2 * d, 6 + 4 * d)
        self.zeros, self.tool = slice(6 + 4 * d, 6 + 5 * d), slice(6 + 5 * d, self.size)
        frames = [reference.fixed[0]]
        for transform in reference.fixed[1:]:
            frames.append(frames[-1] @ transform)
        self._frames = np.stack(frames)
        self._axes = np.einsum("kij,kj->ki", self._frames[:-1, :3, :3], reference.axes)
        self._points = self._frames[:-1, :3, 3]
        self._tangents = tangents(self._axes)
        self._slides = np.flatnonzero(reference.prismatic)
        self._kernel = self._whole_kernel()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the compiled kernel, which can be neither pickled nor copied."""
        state = self.__dict__.copy()
        del state["_kernel"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state, with the kernel that the present process selects."""
        self.__dict__.update(state)
        self._kernel = self._whole_kernel()

    @property
    def tables(self) -> tuple[FloatArray, ...]:
        """Constant inputs of `linearised`.

        Axes and points of the reference at q = 0 (d, 3), the tangents (d, 3, 2), 1 where prismatic (d,), and the
        marker's frame (4, 4).
        """
        return self._axes, self._points, self._tangents, self.reference.prismatic.astype(np.float64), self._frames[-1]

    @property
    def turning(self) -> BoolArray:
        """True for each parameter (size,) that is an angle, and therefore curves the marker's path.

        The others are lengths.
        """
        turning = np.zeros(self.size, dtype=np.bool_)
        turning[self.base_turn] = turning[self.tilts] = True
        turning[self.zeros] = ~self.reference.prismatic
        return turning

    @property
    def reach(self) -> float:
        """Typical distance of the marker from the joint axes [m]: half the length of all links."""
        return max(float(np.linalg.norm(self.reference.fixed[1:, :3, 3], axis=1).sum()) / 2.0, 1e-3)

    def standard_deviations(self, tolerances: ChainTolerances) -> FloatArray:
        """Return the standard deviation (size,) of each parameter; 0 where it is held."""
        prismatic = self.reference.prismatic
        std = np.empty(self.size)
        std[self.base_turn], std[self.base_shift] = tolerances.base_rotation, tolerances.base_translation
        std[self.tilts], std[self.tool] = tolerances.axes, tolerances.tool
        std[self.shifts] = np.repeat(np.where(prismatic, 0.0, tolerances.points), 2)
        std[self.zeros] = np.where(prismatic, tolerances.slide_zeros, tolerances.zeros)
        return std

    def names(self) -> tuple[str, ...]:
        """Return the name of each parameter; joints are counted from 1."""
        joints = range(1, self.reference.joints + 1)
        return (
            *(f"base turn {axis}" for axis in "xyz"),
            *(f"base shift {axis}" for axis in "xyz"),
            *(f"joint {k} axis tilt {side}" for k in joints for side in (1, 2)),
            *(f"joint {k} axis shift {side}" for k in joints for side in (1, 2)),
            *(f"joint {k} zero" for k in joints),
            *(f"tool {axis}" for axis in "xyz"),
        )

    def base_pose(self, change: FloatArray) -> FloatArray:
        """Return T_measured_nominal (4, 4) of a change (size,)."""
        pose = np.eye(4)
        pose[:3, :3] = exponentials(change[None, self.base_turn])[0][0]
        pose[:3, 3] = change[self.base_shift]
        return pose

    def chain(self, change: ArrayLike) -> RigidChain:
        """Return the reference chain with a change (size,) built in; axes keep their values in their own frames."""
        geometry = self._geometry(vector("change", change, self.size))
        frames = self._frames.copy()
        frames[:-1, :3, :3] = geometry.rotations @ frames[:-1, :3, :3]
        frames[:-1, :3, 3], frames[-1, :3, 3] = geometry.points, geometry.tip
        fixed = np.empty_like(frames)
        fixed[0] = geometry.base @ frames[0]
        # J(q + zero) = J(q) J(zero), and T_a J(zero) T_a⁻¹ is the motion that `_motions` gives at q = 0.
        motions = self._motions(geometry, geometry.zeros[None])[:, 0]
        fixed[1:] = np.linalg.inv(frames[:-1]) @ motions @ frames[1:]
        fixed[1:, 3] = (0.0, 0.0, 0.0, 1.0)
        # The products have gathered rounding errors.
        u, _, vt = np.linalg.svd(fixed[:, :3, :3])
        fixed[:, :3, :3] = u @ vt
        return RigidChain(fixed, self.reference.axes, self.reference.prismatic)

    def positions(self, change: ArrayLike, q: ArrayLike) -> FloatArray:
        """Return marker positions [m] (3,) at q (d,), or (n, 3) at (n, d)."""
        angles = rows_or_vector("q", q, self.reference.joints)
        x = self._positions(vector("change", change, self.size), np.atleast_2d(angles))
        return x[0] if angles.ndim == 1 else x

    def jacobian(self, change: ArrayLike, q: ArrayLike) -> FloatArray:
        """Return the derivative of the positions by the joints (3, d) at q (d,), or (n, 3, d) at (n, d).

        Units: m/rad, or m/m.
        """
        angles = rows_or_vector("q", q, self.reference.joints)
        # A joint offset is added to the reading, so the derivatives by both are the same.
        _, jacobian = self.linearised(vector("change", change, self.size), np.atleast_2d(angles))
        columns = jacobian[:, :, self.zeros]
        return columns[0] if angles.ndim == 1 else columns

    def linearised(self, change: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions (n, 3) and their derivatives (n, 3, size) by the change, at q (n, d).

        Inputs are not checked. With R_k the rotation before and R_{k+1} the one after joint k, and r the lever from its
        axis to the marker, a tilt of the axis about u moves the marker by (R_k u − R_{k+1} u) × r, a shift by v moves
        it by R_k v − R_{k+1} v.
        """
        if self._kernel is not None:
            x, jacobian = np.empty((len(q), 3)), np.empty((len(q), 3, self.size))
            self._kernel.linearise(_plain(change), _plain(q), x, jacobian)
            return x, jacobian
        geometry = self._geometry(change)
        angles = q + geometry.zeros
        placed = self._placed(geometry, angles)
        rotations = placed[..., :3, :3]
        x = rotations[-1] @ geometry.tip + placed[-1, :, :3, 3]
        jacobian = np.empty((len(q), 3, self.size))
        before, after = rotations[:-1], rotations[1:]
        across = (before - after) @ np.concatenate([self._tangents, geometry.tilt_turns], axis=2)[:, None]
        axes = before @ geometry.axes[:, None, :, None]
        centres = (before @ geometry.points[:, None, :, None])[..., 0] + placed[:-1, :, :3, 3]
        turning = np.concatenate([across[..., 2:], axes], axis=3)
        moved = cross_matrix(centres - x) @ turning
        for k in self._slides:
            turned_axis = cross_matrix(-geometry.axes[k]) @ geometry.tilt_turns[k]
            moved[k, ..., :2] = angles[:, k, None, None] * (before[k] @ turned_axis)
            moved[k, ..., 2] = axes[k, ..., 0]
        jacobian[:, :, self.base_turn] = cross_matrix(geometry.base[:3, 3] - x) @ geometry.base_turns
        jacobian[:, :, self.base_shift] = _EYE
        by_joint = (len(q), 3, len(moved), 2)
        jacobian[:, :, self.tilts].reshape(by_joint)[...] = moved[..., :2].transpose(1, 2, 0, 3)
        jacobian[:, :, self.shifts].reshape(by_joint)[...] = across[..., :2].transpose(1, 2, 0, 3)
        jacobian[:, :, self.zeros] = moved[..., 2].transpose(1, 2, 0)
        jacobian[:, :, self.tool] = rotations[-1] @ self._frames[-1, :3, :3]
        return x, jacobian

    def lineariser(self, columns: IntArray) -> Callable[[FloatArray, FloatArray, FloatArray, FloatArray], None]:
        """Return a function of change (size,), q (n, d), x (n, 3) and jacobian (n, 3, p), all contiguous.

        It writes the positions to x, and their derivatives by the p parameters `columns` to jacobian.

        Raises:
            SettingError: the columns do not ascend from 0 or above.
        """
        if np.ndim(columns) != 1 or (np.diff(columns, prepend=-1) <= 0).any():
            raise SettingError(f"columns must ascend from 0 or above, each once, got {columns!r}")
        kernel = self._kernel_of(columns)
        if kernel is not None:
            return kernel.linearise

        def linearise(change: FloatArray, q: FloatArray, x: FloatArray, jacobian: FloatArray) -> None:
            x[...], every = self.linearised(change, q)
            jacobian[...] = every[:, :, columns]

        return linearise

    def turned(self, change: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return rotations R (n, 3, 3) of the marker frame at q (n, d), and Ω (n, 3, size); inputs are not checked.

        A small change δ rotates them by dR = [Ω δ]× R. Only the parameters that act through a lever in `linearised`
        rotate them; shifts, tool and prismatic joints do not.
        """
        geometry = self._geometry(change)
        rotations = self._placed(geometry, q + geometry.zeros)[..., :3, :3]
        before, after = rotations[:-1], rotations[1:]
        omega = np.zeros((len(q), 3, self.size))
        omega[:, :, self.base_turn] = geometry.base_turns
        tilts = (before - after) @ geometry.tilt_turns[:, None]
        omega[:, :, self.tilts] = tilts.transpose(1, 2, 0, 3).reshape(len(q), 3, -1)
        axes = (before @ geometry.axes[:, None, :, None])[..., 0]
        axes[self._slides] = 0.0
        omega[:, :, self.zeros] = axes.transpose(1, 2, 0)
        return rotations[-1] @ self._frames[-1, :3, :3], omega

    def _whole_kernel(self) -> FilterKernel | None:
        return self._kernel_of(np.arange(self.size))

    def _kernel_of(self, columns: IntArray) -> FilterKernel | None:
        scales = np.zeros(self.size)
        scales[columns] = 1.0
        # Of the kernel's seven constants the linearisation reads the small angle alone.
        return filter_kernel(*self.tables, scales, scales, np.full(7, RotationSettings.small_rad))

    def _positions(self, change: FloatArray, q: FloatArray) -> FloatArray:
        if self._kernel is not None:
            x = np.empty((len(q), 3))
            self._kernel.linearise(_plain(change), _plain(q), x, None)
            return x
        geometry = self._geometry(change)
        placed = self._placed(geometry, q + geometry.zeros)
        return placed[-1, :, :3, :3] @ geometry.tip + placed[-1, :, :3, 3]

    def _geometry(self, change: FloatArray) -> _Geometry:
        d = self.reference.joints
        tilts = (self._tangents @ change[self.tilts].reshape(d, 2, 1))[..., 0]
        rotations, derivatives = exponentials(np.concatenate([change[None, self.base_turn], tilts]))
        base = np.eye(4)
        base[:3, :3], base[:3, 3] = rotations[0], change[self.base_shift]
        return _Geometry(
            base=base,
            base_turns=derivatives[0],
            axes=(rotations[1:] @ self._axes[..., None])[..., 0],
            points=self._points + (self._tangents @ change[self.shifts].reshape(d, 2, 1))[..., 0],
            tilt_turns=derivatives[1:] @ self._tangents,
            rotations=rotations[1:],
            zeros=change[self.zeros],
            tip=self._frames[-1, :3, 3] + self._frames[-1, :3, :3] @ change[self.tool],
        )

    def _motions(self, geometry: _Geometry, angles: FloatArray) -> FloatArray:
        """Return the motion of each joint alone (d, n, 4, 4) at its angles (n, d), in the frame of q = 0."""
        axes = geometry.axes
        along = axes[:, :, None] * axes[:, None, :]
        values = angles.T[..., None, None]
        motions = np.zeros((*angles.T.shape, 4, 4))
        motions[..., 3, 3] = 1.0
        turns = motions[..., :3, :3]
        # Rodrigues: R = a aᵀ + cos q (1 − a aᵀ) + sin q [a]×
        turns[...] = np.cos(values) * (_EYE - along)[:, None]
        turns += np.sin(values) * cross_matrix(axes)[:, None]
        turns += along[:, None]
        motions[..., :3, 3] = geometry.points[:, None] - (turns @ geometry.points[:, None, :, None])[..., 0]
        for k in self._slides:
            turns[k] = _EYE
            motions[k, :, :3, 3] = angles[:, k, None] * axes[k]
        return motions

    def _placed(self, geometry: _Geometry, angles: FloatArray) -> FloatArray:
        """Return the motion (d+1, n, 4, 4) of everything before joint k, the base first, and of the marker last."""
        motions = self._motions(geometry, angles)
        placed = np.empty((len(motions) + 1, *motions.shape[1:]))
        placed[0] = geometry.base
        for k, motion in enumerate(motions):
            np.matmul(placed[k], motion, out=placed[k + 1])
        return placed


def _plain(values: FloatArray) -> FloatArray:
    """Return the values in the form of the compiled kernel."""
    return np.ascontiguousarray(values, dtype=np.float64)


def tangents(axes: FloatArray) -> FloatArray:
    """Return two unit vectors across each axis and each other, as columns (d, 3, 2)."""
    cross = cross_matrix(axes)
    columns = np.empty((len(axes), 3, 2))
    # axis × e_i, with i the smallest component of the axis
    first = cross[np.arange(len(axes)), :, np.abs(axes).argmin(axis=1)]
    columns[..., 0] = first / np.linalg.norm(first, axis=1, keepdims=True)
    columns[..., 1] = (cross @ columns[..., :1])[..., 0]
    return frozen(columns)


CHAIN = ("fixed", "axes", "prismatic")


def chain_arrays(chain: RigidChain) -> dict[str, FloatArray]:
    """Return a chain as arrays to pack."""
    return {"fixed": chain.fixed, "axes": chain.axes, "prismatic": chain.prismatic.astype(np.float64)}


def chain_from_arrays(arrays: Mapping[str, FloatArray]) -> RigidChain:
    """Return the chain in unpacked arrays.

    Raises:
        KeyError (an array is missing), ModelFormatError, ChainError, ShapeError, NonFiniteError.
    """
    if not np.isin(arrays["prismatic"], (0.0, 1.0)).all():
        raise ModelFormatError("it is not said of every joint whether it slides")
    return RigidChain(arrays["fixed"], arrays["axes"], arrays["prismatic"] != 0.0)


def describe_tolerances(tolerances: ChainTolerances) -> dict[str, float | None]:
    """Return tolerances for JSON: None for an infinite one."""
    return {name: unless_infinite(value) for name, value in asdict(tolerances).items()}


def parse_tolerances(value: Any) -> ChainTolerances:
    """Return the tolerances from `describe_tolerances`.

    Raises:
        ModelFormatError, SettingError: it does not describe one.
    """
    names = [field.name for field in fields(ChainTolerances)]
    described = named(value, "the tolerances", names)
    return ChainTolerances(*(or_infinite(described[name], f"the tolerance {name}") for name in names))
