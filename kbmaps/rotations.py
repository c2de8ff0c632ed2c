"""Rotation matrices: validation, nearest rotation, exponential map, and angles between rotations."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, numbers
from kbmaps.errors import NonFiniteError, RotationError, ShapeError

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation  # pyright: ignore[reportMissingTypeStubs]


class RotationSettings:
    # Accepted deviation of a measured rotation: quaternions and matrices are often written with six digits.
    tolerance = 1e-4
    # Below this angle [rad] the quotients of the exponential map are taken from their series.
    small_rad = 1e-3


_EYE = np.eye(3)
# (3, 9): row i is the matrix K of `cross_matrix` of the unit vector e_i.
_CROSS = np.stack([np.cross(unit, _EYE).T.ravel() for unit in _EYE])


def nearest_rotation(matrices: ArrayLike) -> FloatArray:
    """Return the proper rotations (..., 3, 3) nearest to matrices (..., 3, 3) in the Frobenius norm.

    The orthogonal factor of the polar decomposition, with the smallest singular direction reversed if the matrix is
    a reflection. Higham 1986, "Computing the polar decomposition"; Kabsch 1976 for the sign.

    Example:
        >>> from kbmaps import nearest_rotation
        >>> nearest_rotation([[1.1, 0.0, 0.0], [0.0, 0.9, 0.0], [0.0, 0.0, 1.0]])
        array([[1., 0., 0.],
               [0., 1., 0.],
               [0., 0., 1.]])
    """
    checked = numbers("matrices", matrices)
    if checked.shape[-2:] != (3, 3):
        raise ShapeError("matrices", "(..., 3, 3)", checked.shape)
    if not np.isfinite(checked).all():
        raise NonFiniteError("matrices")
    u, _, vt = np.linalg.svd(checked)
    handed = np.ones(checked.shape[:-1])
    handed[..., 2] = np.where(np.linalg.det(u @ vt) < 0.0, -1.0, 1.0)
    return (u * handed[..., None, :]) @ vt


def nearest_rotation_rates(matrices: FloatArray, derivatives: FloatArray) -> FloatArray:
    """Return the angular velocities ω (..., 3, d) of the rotations R nearest to matrices (..., 3, 3).

    dR = [ω_k]× R dq_k. With M = R P, Rᵀ dM − dMᵀ R = Ω P + P Ω, and for [ω]× = Ω this is [(tr P · 1 − P) ω]×: exact,
    even if M is not orthonormal.

    Args:
        matrices: M (..., 3, 3).
        derivatives: dM/dq_k (..., 3, 3, d).
    """
    rotations = nearest_rotation(matrices)
    stretch = rotations.swapaxes(-1, -2) @ matrices
    stretch = 0.5 * (stretch + stretch.swapaxes(-1, -2))
    turned = np.einsum("...ji,...jak->...iak", rotations, derivatives)
    skew = turned - turned.swapaxes(-2, -3)
    twice = np.stack([skew[..., 2, 1, :], skew[..., 0, 2, :], skew[..., 1, 0, :]], axis=-2)
    trace = np.trace(stretch, axis1=-2, axis2=-1)[..., None, None]
    return rotations @ cast(FloatArray, np.linalg.solve(trace * np.eye(3) - stretch, twice))


def _rotation_type() -> type[Rotation]:
    """Import scipy's rotations on first use: it takes 0.4 s of CPU, and most commands do not need them."""
    from scipy.spatial.transform import Rotation  # pyright: ignore[reportMissingTypeStubs]

    return Rotation


def rotation_vector(rotation: FloatArray) -> FloatArray:
    """Return axis times angle (3,) [rad], angle at most π, of a rotation matrix (3, 3)."""
    return np.asarray(_rotation_type().from_matrix(rotation).as_rotvec(), dtype=np.float64)


def rotation_vectors(rotations: FloatArray) -> FloatArray:
    """Return axis times angle (n, 3) [rad], angles at most π, of rotation matrices (n, 3, 3)."""
    if not len(rotations):  # scipy refuses an empty batch
        return np.empty((0, 3))
    return np.asarray(_rotation_type().from_matrix(rotations).as_rotvec(), dtype=np.float64)


def quaternions(rotations: FloatArray) -> FloatArray:
    """Return unit quaternions x, y, z, w (n, 4), with w not negative, of rotation matrices (n, 3, 3)."""
    if not len(rotations):
        return np.empty((0, 4))
    return np.asarray(_rotation_type().from_matrix(rotations).as_quat(canonical=True), dtype=np.float64)


def exponentials(turns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotations exp([φ]×) (n, 3, 3) of rotation vectors (n, 3) [rad], and their left Jacobians (n, 3, 3).

    Rodrigues' formula, and exp([φ + δ]×) = exp([J δ]×) exp([φ]×) to first order, with the left Jacobian J
    (Chirikjian 2012, section 10.8).
    """
    angles: FloatArray = np.sqrt(np.einsum("ki,ki->k", turns, turns))[:, None, None]
    safe: FloatArray = np.maximum(angles, RotationSettings.small_rad)
    small: BoolArray = angles < RotationSettings.small_rad
    squares = angles * angles
    sine: FloatArray = np.where(small, 1.0 - squares / 6.0, np.sin(safe) / safe)
    cosine: FloatArray = np.where(small, 0.5 - squares / 24.0, (1.0 - np.cos(safe)) / (safe * safe))
    rest: FloatArray = np.where(small, 1.0 / 6.0 - squares / 120.0, (1.0 - np.sin(safe) / safe) / (safe * safe))
    k = cross_matrix(turns)
    kk = k @ k
    return _EYE + sine * k + cosine * kk, _EYE + cosine * k + rest * kk


def cross_matrix(vectors: FloatArray) -> FloatArray:
    """Return the matrices K (..., 3, 3) with K @ y = vectors × y, for vectors (..., 3)."""
    # A single product, because this is called for every incoming pair.
    return (vectors @ _CROSS).reshape(*vectors.shape, 3)


def rotation_matrices(name: str, values: ArrayLike) -> FloatArray:
    """Return measured orientations as proper rotation matrices (3, 3) or (n, 3, 3).

    Args:
        name: name of the argument, for error messages.
        values: rotation matrices (3, 3) or (n, 3, 3), or unit quaternions x, y, z, w, (4,) or (n, 4). Deviations up to
            1e-4 are corrected.

    Raises:
        ShapeError, NonFiniteError, RotationError: neither matrices nor quaternions of rotations.
    """
    given = numbers(name, values)
    is_quaternion = given.ndim in (1, 2) and given.shape[-1:] == (4,)
    if not is_quaternion and not (given.ndim in (2, 3) and given.shape[-2:] == (3, 3)):
        raise ShapeError(name, "(3, 3) or (n, 3, 3), or (4,) or (n, 4) for quaternions", given.shape)
    if not np.isfinite(given).all():
        raise NonFiniteError(name)
    if is_quaternion:
        off = np.abs(np.linalg.norm(given, axis=-1) - 1.0)
        if given.size and off.max() > RotationSettings.tolerance:
            raise RotationError(name, "a quaternion is not of length 1")
        # scipy refuses an empty batch.
        return (
            np.asarray(_rotation_type().from_quat(given).as_matrix(), dtype=np.float64)
            if given.size
            else np.empty((0, 3, 3))
        )
    fixed = nearest_rotation(given)
    if given.size and np.abs(fixed - given).max() > RotationSettings.tolerance:
        raise RotationError(name, "a matrix is no proper rotation (orthonormal, determinant 1)")
    return fixed
