"""Pairs of joint angles and measured positions, and their validation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, IntArray, numbers, rows, rows_or_vector
from kbmaps.errors import ModelFormatError, NonFiniteError, SettingError, ShapeError
from kbmaps.packed import restoring


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs q (n, d) [rad, m] and x (n, 3) [m]."""

    q: FloatArray
    x: FloatArray
    unit: FloatArray  # 1-sigma (n,) of each coordinate [m] up to a common factor; the geometric mean of all directions
    known: bool  # True if that factor is 1; otherwise it has to be estimated
    # (n, 3, 3): matrices that make the errors isotropic; None if they are. Of determinant 1 if `known`
    shape: FloatArray | None = None
    # (n, 3, k) [m], errors caused by k unknowns that all pairs share, at 1 sigma of each; None without any
    common: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.q)

    def chosen(self, mask: BoolArray | IntArray) -> Pairs:
        """Return the pairs selected by a mask (n,) or by indices, in the same units."""
        shape, common = (None if each is None else each[mask] for each in (self.shape, self.common))
        return Pairs(self.q[mask], self.x[mask], self.unit[mask], self.known, shape, common)

    def whitened(self, errors: FloatArray) -> FloatArray:
        """Return errors (n, 3) or (n, 3, k) [m], scaled to be isotropic."""
        if self.shape is None:
            return errors
        return (self.shape @ errors[..., None])[..., 0] if errors.ndim == 2 else self.shape @ errors


def with_units(
    q: FloatArray, x: FloatArray, sigma: FloatArray, shape: FloatArray | None = None, common: FloatArray | None = None
) -> Pairs:
    """Return pairs from their sigma (n,) [m], NaN if unknown, and the rest as in `Pairs`.

    As soon as one is unknown, the others count relative to their median, which also replaces the missing ones.
    """
    given = ~np.isnan(sigma)
    if given.all():
        return Pairs(q, x, sigma, len(q) > 0, shape, common)
    if not given.any():
        return Pairs(q, x, np.ones(len(q)), False, shape, common)
    return Pairs(q, x, np.where(given, sigma / np.median(sigma[given]), 1.0), False, shape, common)


def stored_pairs(arrays: Mapping[str, FloatArray], joints: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return q (n, d), x (n, 3) and sigma (n,), NaN if unknown, from the arrays of a stored model."""
    with restoring("pairs"):
        q, x, sigma = rows("q", arrays["q"], joints), rows("x", arrays["x"], 3), arrays["sigma"]
        if not sigma.shape == (len(q),) == (len(x),):
            raise ModelFormatError(f"q, x and sigma are of different pairs: {q.shape}, {x.shape} and {sigma.shape}")
        if (sigma <= 0.0).any():
            raise ModelFormatError("a stored sigma is not greater than 0 m")
    return q, x, sigma


def checked_pairs(
    q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None, joints: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return q (n, d), x (n, 3) and sigma (n,), NaN for None, from many pairs or one.

    Raises:
        ShapeError, NonFiniteError, SettingError: a sigma that is not positive.
    """
    angles = np.atleast_2d(rows_or_vector("q", q, joints))
    positions = np.atleast_2d(rows_or_vector("x", x, 3))
    if len(angles) != len(positions):
        raise ShapeError("x", f"({len(angles)}, 3) to go with q", positions.shape)
    if sigma is None:
        return angles, positions, np.full(len(angles), np.nan)
    if isinstance(sigma, float) and 0.0 < sigma < math.inf:
        return angles, positions, np.full(len(angles), sigma)
    sigmas = numbers("sigma", sigma)
    if sigmas.shape not in ((), (len(angles),)):
        raise ShapeError("sigma", f"() or ({len(angles)},)", sigmas.shape)
    if not np.isfinite(sigmas).all():
        raise NonFiniteError("sigma")
    if sigmas.size and sigmas.min() <= 0.0:
        raise SettingError("every sigma must be greater than 0 m; pass None where the noise is not known")
    return angles, positions, np.broadcast_to(sigmas, (len(angles),))


def of_covariances(covariances: ArrayLike, pairs: int) -> tuple[FloatArray, FloatArray]:
    """Return sigma (n,) [m] and shape (n, 3, 3), as in `Pairs`, of errors with covariances (n, 3, 3), or (3, 3), [m²].

    Raises:
        ShapeError, NonFiniteError, SettingError: one is not positive definite.
    """
    cov = numbers("cov", covariances)
    if cov.shape not in ((3, 3), (pairs, 3, 3)):
        raise ShapeError("cov", f"(3, 3) or ({pairs}, 3, 3)", cov.shape)
    if not np.isfinite(cov).all():
        raise NonFiniteError("cov")
    try:
        roots = np.linalg.cholesky(np.broadcast_to(cov, (pairs, 3, 3)))
    except np.linalg.LinAlgError as error:
        raise SettingError("every covariance must be symmetric and positive definite") from error
    sigma = np.cbrt(np.diagonal(roots, axis1=1, axis2=2).prod(axis=1))
    return sigma, sigma[:, None, None] * np.linalg.inv(roots)
