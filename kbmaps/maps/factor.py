"""Rows of a least-squares problem in bounded memory."""

from __future__ import annotations

import numpy as np

from kbmaps import lapack
from kbmaps.arrays import FloatArray


class RowFactor:
    """Rows A (k, m) and targets (k, outputs) of a least-squares problem, never more of them than unknowns.

    Up to m rows are kept unchanged. After that A is their triangular QR factor, into which later rows are folded:
    for every g, the squares of A g − targets stay the sum over all rows ever added, up to a constant that no g changes.
    Memory and cost per row stay constant. No normal equations are formed, so no digits are lost to squaring the
    condition number. Inputs are not checked.
    """

    def __init__(self, unknowns: int, outputs: int) -> None:
        self.unknowns = unknowns
        self._rows = np.zeros((unknowns, unknowns))
        self._targets = np.zeros((unknowns, outputs))
        self._filled = 0
        self._triangular = False

    @property
    def rows(self) -> FloatArray:
        """Matrix A (k, m); upper triangular once k = m."""
        return self._rows[: self._filled]

    @property
    def targets(self) -> FloatArray:
        """Targets (k, outputs) that go with `rows`."""
        return self._targets[: self._filled]

    def add(self, rows: FloatArray, targets: FloatArray) -> None:
        """Add rows (n, m) with targets (n, outputs)."""
        taken = 0
        if not self._triangular:
            taken = min(len(rows), self.unknowns - self._filled)
            self._rows[self._filled : self._filled + taken] = rows[:taken]
            self._targets[self._filled : self._filled + taken] = targets[:taken]
            self._filled += taken
            if self._filled == self.unknowns:
                self._rows = np.asfortranarray(self._rows)
                self._rows, self._targets = lapack.qr_in_place(self._rows, np.asfortranarray(self._targets))
                self._triangular = True
        if taken < len(rows):
            below, below_targets = np.asfortranarray(rows[taken:]), np.array(targets[taken:], order="F")
            self._rows, self._targets = lapack.qr_append(self._rows, self._targets, below, below_targets)


class ShiftedGram:
    """Factorisation of K + λ I for one λ after the other, within K's own buffer.

    The Cholesky factor is in the lower triangle and the diagonal, K itself in the upper one and a copy of its
    diagonal.

    Args:
        gram: K (k, k), Fortran-ordered, positive semidefinite; only the upper triangle is read. Taken over, not copied.
    """

    _COPY_COLUMNS = 64

    def __init__(self, gram: FloatArray) -> None:
        self._buffer = gram
        self._diagonal = gram.diagonal().copy()
        self.shift: float | None = None

    @property
    def size(self) -> int:
        """Number of rows and columns k."""
        return len(self._diagonal)

    @property
    def trace(self) -> float:
        return float(self._diagonal.sum())

    def factorise(self, shift: float) -> bool:
        """Factorise K + shift·I; return False (unusable until the next call) if it is not positive definite."""
        if self.shift == shift:
            return True
        size, step = len(self._buffer), self._COPY_COLUMNS
        for begin in range(0, size, step):
            end = min(begin + step, size)
            self._buffer[end:, begin:end] = self._buffer[begin:end, end:].T
            corner = self._buffer[begin:end, begin:end]
            corner[:] = np.triu(corner, 1) + np.triu(corner, 1).T
        np.einsum("ii->i", self._buffer)[:] = self._diagonal + shift
        self._buffer, positive = lapack.cholesky_lower(self._buffer)
        self.shift = shift if positive else None
        return positive

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return the solution of (K + shift·I) y = rhs."""
        return lapack.cholesky_solve(self._buffer, rhs)

    def whiten(self, rhs: FloatArray) -> FloatArray:
        """Return L⁻¹ rhs, with L Lᵀ = K + shift·I."""
        return lapack.lower_solve(self._buffer, rhs)

    @property
    def rcond(self) -> float:
        """Estimated reciprocal condition number of K + shift·I, at least 1 / k of the true one."""
        norm = self.trace + (self.shift or 0.0) * self.size
        return lapack.cholesky_rcond(self._buffer, norm)

    @property
    def log_determinant(self) -> float:
        """log det (K + shift·I)."""
        return 2.0 * float(np.log(self._buffer.diagonal()).sum())
