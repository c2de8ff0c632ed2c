"""Least squares with few unknowns, many times a frame: NumPy's own routines cost more than the arithmetic."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray

# Below this, relative to the cubed trace, an outline does not determine centre and radius.
_LEAST_DETERMINANT = 1e-6


def inverse_of_normal(normal: FloatArray) -> FloatArray | None:
    """Invert a normal matrix (3, 3); None if it determines too little."""
    (a, b, c), (_, d, e), (_, _, f) = normal.tolist()
    # Cofactors of a symmetric matrix.
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * A + b * B + c * C
    if not determinant >= _LEAST_DETERMINANT * (a + d + f) ** 3 or determinant <= 0:
        return None
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    return np.array([[A, B, C], [B, D, E], [C, E, F]]) / determinant
