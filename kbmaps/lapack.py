"""Typed access to the BLAS and LAPACK routines used here.

They work on Fortran order and may overwrite their inputs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any, cast

import numpy as np

from kbmaps.arrays import FloatArray

_PANEL_COLUMNS = 32


@cache
def _routine(name: str, library: str = "lapack") -> Callable[..., Any]:
    """Import scipy.linalg on first use: it takes 0.2 s of CPU, and not every command needs it."""
    return cast(Callable[..., Any], getattr(import_module(f"scipy.linalg.{library}"), name))


def add_outer_in_place(matrix: FloatArray, column: FloatArray, row: FloatArray) -> None:
    """Add column (n,) ⊗ row (m,) to the matrix (n, m), in C order, without a temporary of its size."""
    _routine("dger", "blas")(1.0, row, column, a=matrix.T, overwrite_a=1)


def qr_in_place(square: FloatArray, targets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return R (m, m) and Qᵀ·targets for a square matrix, overwriting both."""
    size = len(square)
    factor, tau, _, _ = _routine("dgeqrf")(square, lwork=64 * size, overwrite_a=1)
    rotated, _, _ = _routine("dormqr")("L", "T", factor, tau, targets, lwork=64 * size, overwrite_c=1)
    for column in range(size):
        factor[column + 1 :, column] = 0.0
    return factor, rotated


def qr_append(
    factor: FloatArray, targets: FloatArray, rows: FloatArray, row_targets: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return R and Qᵀ·targets after rows were appended below them. Overwrites all four."""
    panel = min(_PANEL_COLUMNS, len(factor))
    updated, reflectors, blocks, _ = _routine("dtpqrt")(0, panel, factor, rows, overwrite_a=1, overwrite_b=1)
    rotated, _, _ = _routine("dtpmqrt")(
        0, reflectors, blocks, targets, row_targets, side="L", trans="T", overwrite_a=1, overwrite_b=1
    )
    return updated, rotated


def cholesky_lower(symmetric: FloatArray) -> tuple[FloatArray, bool]:
    """Return the matrix with its Cholesky factor in the lower triangle, and True if it was positive definite.

    Overwrites the matrix; the part above the diagonal is neither read nor written.
    """
    factored, info = _routine("dpotrf")(symmetric, lower=1, clean=0, overwrite_a=1)
    return cast(FloatArray, factored), info == 0


def cholesky_solve(lower: FloatArray, rhs: FloatArray) -> FloatArray:
    """Return the solution of L Lᵀ y = rhs."""
    solution, _ = _routine("dpotrs")(lower, rhs, lower=1)
    return cast(FloatArray, solution)


def lower_solve(lower: FloatArray, rhs: FloatArray) -> FloatArray:
    """Return the solution of L y = rhs, of a lower triangular matrix without zeros on its diagonal."""
    return cast(FloatArray, _routine("dtrtrs")(lower, rhs, lower=1)[0])


def lower_inverse(lower: FloatArray) -> FloatArray:
    """Return the inverse of a lower triangular matrix without zeros on its diagonal."""
    # In C order it is the transpose of an upper one in Fortran order, which LAPACK accepts without a copy.
    inverse, _ = _routine("dtrtri")(lower.T, lower=0)
    return cast(FloatArray, inverse).T


def cholesky_rcond(lower: FloatArray, norm: float) -> float:
    """Return the estimated reciprocal condition number of L Lᵀ, whose norm is given."""
    rcond, _ = _routine("dpocon")(lower, norm, uplo="L")
    return float(rcond)


def triangular_solve(upper: FloatArray, rhs: FloatArray, smallest_rcond: float) -> FloatArray | None:
    """Return the solution of U y = rhs; None if U is nearer to singular than smallest_rcond."""
    rcond, _ = _routine("dtrcon")(upper, norm="1", uplo="U", diag="N")
    if not rcond > smallest_rcond:
        return None
    return cast(FloatArray, _routine("dtrtrs")(upper, rhs, lower=0)[0])


def smallest_solution(rows: FloatArray, rhs: FloatArray, smallest_rcond: float) -> FloatArray | None:
    """Return the least-norm solution (m, outputs) of rows (k, m) @ y = rhs with k <= m, by the QR factors of rowsᵀ.

    None if the rows are nearer to linearly dependent than smallest_rcond.
    """
    count, unknowns = rows.shape
    factor, tau, _, _ = _routine("dgeqrf")(rows.T.copy(order="F"), lwork=64 * count, overwrite_a=1)
    # The triangular routines do not read the reflectors below the diagonal.
    upper = np.asfortranarray(factor[:count])
    rcond, _ = _routine("dtrcon")(upper, norm="1", uplo="U", diag="N")
    if not rcond > smallest_rcond:
        return None
    solution = np.zeros((unknowns, rhs.shape[1]), order="F")
    solution[:count] = _routine("dtrtrs")(upper, rhs, lower=0, trans=1)[0]
    rotated, _, _ = _routine("dormqr")("L", "N", factor, tau, solution, lwork=64 * count, overwrite_c=1)
    return cast(FloatArray, rotated)
