"""Noise of single pairs: the camera's measurement noise and the joints' reading errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from kbmaps.arrays import FloatArray, frozen
from kbmaps.robust import CLIPPED_SIGMAS

# Number of steps towards the maximum likelihood; each increases it.
_STEPS = 60
# Minimum number of pairs for each estimated variance.
_FEWEST = 10
# Lower bound of a variance as a share of all: it would vanish in rounding.
_LEAST = 1e-9
# Positions of the six numbers of a symmetric matrix: xx, yy, zz, yz, xz, xy.
_ROWS, _COLUMNS = [0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]


@dataclass(frozen=True, eq=False)
class WhiteNoise:
    """Variances of the error that each pair has by itself, not shared with its neighbours.

    A pair's error has the covariance

        a C + b 1 + Σ_j s_j² J_j J_jᵀ

    with the claimed covariance C of the measured position, and the derivatives J_j of the position by joint j: an
    encoder's ticks move the predicted position along them, so the axes of the position err together.

    Attributes:
        claimed: a, the factor by which the claimed covariance is too small; never below 1, as a camera's claimed error
            may be shared by neighbours where the marker is partly hidden for a while.
        beside: b, the same on all axes [m²].
        joints: s_j², of the joints' readings (d,) [rad², m²].
    """

    claimed: float
    beside: float
    joints: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", frozen(self.joints))

    @classmethod
    def as_claimed(cls, joints: int) -> Self:
        """Return the noise that the camera claims, for this number of joints."""
        return cls(1.0, 0.0, np.zeros(joints))

    @classmethod
    def of(cls, errors: FloatArray, covariances: FloatArray, derivatives: FloatArray) -> Self:
        """Estimate the noise from differences of neighbours, in which errors of the model cancel.

        Maximum likelihood variances of Gaussian differences, by the MM algorithm of Zhou, Hu, Zhou and Lange (2019, "MM
        algorithms for variance components models"). It keeps variances positive and each step increases the likelihood.
        With too few pairs, the noise is as claimed.

        Args:
            errors: of a model's predictions (n, 3) [m], in the order of the pairs.
            covariances: claimed of the measured positions (n, 3, 3) [m²].
            derivatives: of the positions by the joints (n, 3, d) [m/rad, or 1 for a prismatic joint].
        """
        joints = derivatives.shape[2]
        if len(errors) - 1 < _FEWEST * (joints + 2):
            return cls.as_claimed(joints)
        off = np.diff(errors, axis=0) * np.sqrt(0.5)
        alike = np.broadcast_to(np.eye(3), (len(errors), 1, 3, 3))
        spread = np.concatenate([_outer(derivatives), covariances[:, None], alike], axis=1)
        spread = 0.5 * (spread[1:] + spread[:-1])
        # In units in which each alone would explain the differences.
        typical = np.median(np.square(off).sum(axis=1))
        units = max(float(typical), 1e-30) / np.maximum(np.trace(spread, axis1=2, axis2=3).mean(axis=0), 1e-30)
        spread = spread * units[:, None, None]
        shares, likelihood = _most_probable(spread, off)
        of_camera, without_joints = _most_probable(spread[:, joints:], off)
        # The errors of joints that turn in all directions resemble isotropic noise: they need evidence (Schwarz 1978).
        if likelihood - without_joints < 0.5 * joints * np.log(3.0 * len(off)):
            shares = np.concatenate([np.zeros(joints), of_camera])
        variances = shares * units
        return cls(max(float(variances[-2]), 1.0), float(variances[-1]), variances[:joints])

    def of_readings(self, derivatives: FloatArray) -> FloatArray:
        """Return the part of the joints' readings in pairs' errors (n, 3, 3) [m²]; the argument as in `of`."""
        return (derivatives * self.joints) @ derivatives.mT

    def covariances(self, covariances: FloatArray, derivatives: FloatArray) -> FloatArray:
        """Return covariances of pairs' errors (n, 3, 3) [m²]; arguments as in `of`."""
        return self.claimed * covariances + self.beside * np.eye(3) + self.of_readings(derivatives)


def _most_probable(spread: FloatArray, off: FloatArray) -> tuple[FloatArray, float]:
    """Return shares (k,) of covariances (n, k, 3, 3) in that of `off` (n, 3), and their log-likelihood [nats]."""
    n, k = spread.shape[:2]
    parts = np.ascontiguousarray(spread[:, :, _ROWS, _COLUMNS].transpose(1, 2, 0)).reshape(k, 6 * n)
    shares, likelihood = np.full(k, 1.0 / k), -np.inf
    for _ in range(_STEPS):
        root = _inverse_root((shares @ parts).reshape(6, n))
        whitened = _turned(root, off.T)
        far = np.square(whitened).sum(axis=0)
        likelihood = float(np.log(root[0] * root[2] * root[5]).sum())
        likelihood -= 0.5 * float(np.minimum(far, CLIPPED_SIGMAS**2).sum())
        whitened *= np.minimum(1.0, CLIPPED_SIGMAS / np.sqrt(np.maximum(far, 1e-300)))
        x, y, z = _turned_back(root, whitened)
        seen = parts @ np.concatenate([x * x, y * y, z * z, 2.0 * y * z, 2.0 * x * z, 2.0 * x * y])
        expected = parts @ _inverse_of(root).ravel()
        shares = np.maximum(shares * np.sqrt(seen / expected), _LEAST)
    return shares, likelihood


def _inverse_root(covariances: FloatArray) -> FloatArray:
    """Return inverses of the Cholesky factors (6, n), row by row, of covariances (6, n), in the order of `_ROWS`."""
    xx, yy, zz, yz, xz, xy = covariances
    a = 1.0 / np.sqrt(xx)
    lower_yx, lower_zx = xy * a, xz * a
    c = 1.0 / np.sqrt(yy - lower_yx**2)
    lower_zy = (yz - lower_zx * lower_yx) * c
    f = 1.0 / np.sqrt(zz - lower_zx**2 - lower_zy**2)
    b = -lower_yx * a * c
    return np.stack([a, b, c, -(lower_zx * a + lower_zy * b) * f, -lower_zy * c * f, f])


def _turned(root: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return lower triangles (6, n) times vectors (3, n)."""
    (a, b, c, d, e, f), (x, y, z) = root, vectors
    return np.stack([a * x, b * x + c * y, d * x + e * y + f * z])


def _turned_back(root: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return transposed lower triangles (6, n) times vectors (3, n)."""
    (a, b, c, d, e, f), (x, y, z) = root, vectors
    return np.stack([a * x + b * y + d * z, c * y + e * z, f * z])


def _inverse_of(root: FloatArray) -> FloatArray:
    """Return transposed lower triangles times themselves (6, n); off-diagonal entries are doubled."""
    a, b, c, d, e, f = root
    return np.stack([a * a + b * b + d * d, c * c + e * e, f * f, 2.0 * e * f, 2.0 * d * f, 2.0 * (b * c + d * e)])


def inverse_roots(covariances: FloatArray) -> FloatArray:
    """Return the symmetric roots of the inverses (n, 3, 3), which rotate no axis more than necessary."""
    values, vectors = np.linalg.eigh(covariances)
    return (vectors / np.sqrt(values)[:, None, :]) @ vectors.mT


def _outer(derivatives: FloatArray) -> FloatArray:
    """Return the outer product of each joint's column (n, 3, d) with itself, (n, d, 3, 3)."""
    columns = derivatives.mT
    return columns[..., :, None] * columns[..., None, :]
