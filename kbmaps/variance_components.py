"""Covariances of errors, estimated as sums of parts of known shape."""

from __future__ import annotations

import numpy as np

from kbmaps.arrays import FloatArray, evenly_spread
from kbmaps.robust import RobustSettings


class _Settings:
    steps = 60  # number of steps towards the maximum likelihood; each increases it
    min_share = 1e-9  # Lower bound of a variance as a share of all: it would vanish in rounding
    # Errors that the shares are estimated from, evenly spread: they determine four numbers to a few percent, and
    # weights that are wrong by so much cost a thousandth.
    max_errors = 500
    alike_share = 1e-6  # variances of a covariance that differ by less than this share are the same


# Positions of the six numbers of a symmetric matrix: xx, yy, zz, yz, xz, xy.
_ROWS, _COLUMNS = [0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]


def is_anisotropic(stated: FloatArray) -> bool:
    """Return True if any of the stated covariances (n, 3, 3), NaN if missing, is anisotropic."""
    values = np.linalg.eigvalsh(stated[~np.isnan(stated).any(axis=(1, 2))])
    return bool((values[:, 2] - values[:, 0] > _Settings.alike_share * values[:, 2]).any())


def error_covariances(errors: FloatArray, stated: FloatArray, readings: FloatArray) -> FloatArray:
    """Estimate the covariances (n, 3, 3) [m²] of errors, whose stated ones may be wrong in size and in shape.

    Each is a C + c D + r J Jᵀ + b 1, with common factors a, c, r, b ≥ 0 that make the errors most probable. C is the
    stated covariance, D its part along its least certain direction, such as a camera's depth, J the derivatives by the
    joints' readings, and b the unexplained part. The stated covariance alone would put all weight on directions that
    nothing else measures equally well.

    Args:
        errors: errors of a model's predictions (n, 3) [m].
        stated: covariances of the measured positions (n, 3, 3) [m²], NaN or 0 if not stated; at least one is.
        readings: J, derivatives of the positions by the joints (n, 3, d) [m/rad].
    """
    variances = np.trace(stated, axis1=1, axis2=2) / 3.0
    has_stated = variances > 0.0
    stated = np.where(has_stated[:, None, None], stated, np.eye(3) * float(variances[has_stated].mean()))
    values, axes = np.linalg.eigh(stated)
    least_certain = axes[:, :, 2] * np.sqrt(values[:, 2:])
    parts = np.stack(
        [
            stated,
            least_certain[:, :, None] * least_certain[:, None, :],
            readings @ readings.mT,
            np.broadcast_to(np.eye(3), stated.shape),
        ],
        axis=1,
    )
    parts = parts[:, parts.any(axis=(0, 2, 3))]
    sample = evenly_spread(len(errors), _Settings.max_errors)
    spread, units = in_typical_units(parts[sample], errors[sample])
    shares, _ = most_probable_shares(spread, errors[sample], leave_out=True)
    return np.einsum("k,nkij->nij", shares * units, parts) + RobustSettings.rounding_m**2 * np.eye(3)


def in_typical_units(spread: FloatArray, off: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return covariances (n, k, 3, 3), each times the factor (k,) with which it alone would explain `off` (n, 3)."""
    typical = float(np.median(np.square(off).sum(axis=1)))
    units = max(typical, 1e-30) / np.maximum(np.trace(spread, axis1=2, axis2=3).mean(axis=0), 1e-30)
    return spread * units[:, None, None], units


def most_probable_shares(spread: FloatArray, off: FloatArray, *, leave_out: bool = False) -> tuple[FloatArray, float]:
    """Return factors (k,) of covariances (n, k, 3, 3) in that of `off` (n, 3), and their log-likelihood [nats].

    By the MM algorithm of Zhou, Hu, Zhou and Lange (2019, "MM algorithms for variance components models"). Large errors
    are clipped, or left out: from one in sixteen on, clipped ones would let a part that explains them grow without
    limit.
    """
    n, k = spread.shape[:2]
    parts = np.ascontiguousarray(spread[:, :, _ROWS, _COLUMNS].transpose(1, 2, 0)).reshape(k, 6 * n)
    shares, likelihood = np.full(k, 1.0 / k), -np.inf
    for _ in range(_Settings.steps):
        root = _inverse_root((shares @ parts).reshape(6, n))
        whitened = _turned(root, off.T)
        far = np.square(whitened).sum(axis=0)
        near = far <= (max(RobustSettings.clipped_sigmas**2, float(np.median(far))) if leave_out else np.inf)
        likelihood = float(np.log(root[0] * root[2] * root[5]).sum())
        likelihood -= 0.5 * float(np.minimum(far, RobustSettings.clipped_sigmas**2).sum())
        whitened *= np.minimum(1.0, RobustSettings.clipped_sigmas / np.sqrt(np.maximum(far, 1e-300)))
        x, y, z = _turned_back(root, whitened * near)
        seen = parts @ np.concatenate([x * x, y * y, z * z, 2.0 * y * z, 2.0 * x * z, 2.0 * x * y])
        expected = parts @ (_inverse_of(root) * near).ravel()
        shares = np.maximum(shares * np.sqrt(seen / expected), _Settings.min_share)
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
