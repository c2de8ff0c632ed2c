"""Convert covariances to and from their upper triangles, row by row."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .records import FloatArray

Upper = tuple[float, float, float, float, float, float]
_ROWS, _COLUMNS = np.triu_indices(3)


def upper_triangles(cov: FloatArray) -> FloatArray:
    """Return xx, xy, xz, yy, yz, zz of covariances of shape (..., 3, 3), shape (..., 6)."""
    return cov[..., _ROWS, _COLUMNS]


def upper_triangle(cov: FloatArray) -> Upper:
    """Return the upper triangle of one covariance as plain numbers."""
    xx, xy, xz, yy, yz, zz = upper_triangles(cov).tolist()
    return xx, xy, xz, yy, yz, zz


def from_upper(upper: ArrayLike) -> FloatArray:
    """Return covariances (..., 3, 3) from their upper triangles (..., 6)."""
    values = np.asarray(upper, dtype=np.float64)
    cov = np.empty((*values.shape[:-1], 3, 3))
    cov[..., _ROWS, _COLUMNS] = cov[..., _COLUMNS, _ROWS] = values
    return cov
