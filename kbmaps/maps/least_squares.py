"""Least squares without regularisation: the smallest change that explains the data exactly."""

from __future__ import annotations

import numpy as np

from kbmaps import lapack
from kbmaps.arrays import FloatArray
from kbmaps.maps.design import Design
from kbmaps.maps.factor import ShiftedGram

# Below this reciprocal condition number a triangular solve would return rounding errors.
_SMALLEST_RCOND = 1e-13
# The same for a Gram matrix, of which the refinement through the pairs needs only the first digits.
_SMALLEST_GRAM_RCOND = 1e-15
# Refinement must gain this factor per step; otherwise the Gram matrix is too near to singular.
_LEAST_GAIN = 10.0
# Relative to the trace of the Gram matrix: just enough for a stable Cholesky factorisation.
_VANISHING_RIDGE = 1e-13
_REFINEMENTS = 30


def nearest_solution(design: Design, errors: FloatArray) -> FloatArray:
    """Return the smallest change (m, outputs) of the coefficients that explains errors (n, outputs) best.

    Uses Cholesky factors of the Gram matrix where they suffice. Refinement through the pairs then matches a QR
    factorisation (corrected seminormal equations, Björck 1987), at a tenth of its cost.
    """
    gram = ShiftedGram(design.gram())
    if gram.factorise(0.0) and gram.rcond > _SMALLEST_GRAM_RCOND:
        change = _refined(design, gram, errors)
        if change is not None:
            return change
    del gram
    return _by_rows(design, errors)


def _refined(design: Design, gram: ShiftedGram, errors: FloatArray) -> FloatArray | None:
    """Refine down to rounding; return None if the steps gain too little."""

    def step(remaining: FloatArray) -> FloatArray:
        if design.overdetermined:
            return gram.solve(design.transposed_times(remaining))
        return design.transposed_times(gram.solve(remaining))

    change = step(errors)
    left = float(np.linalg.norm(change))
    if left == 0.0:
        return change
    for done in range(_REFINEMENTS):
        correction = step(errors - design.times(change))
        size = float(np.linalg.norm(correction))
        if not size * _LEAST_GAIN < left:
            return change if done else None
        change, left = change + correction, size
    return change


def _by_rows(design: Design, errors: FloatArray) -> FloatArray:
    """Solve through the rows themselves or their QR factor."""
    if design.overdetermined:
        factor = design.factor(errors)
        rows, targets = factor.rows, factor.targets
        change = lapack.triangular_solve(rows, targets, _SMALLEST_RCOND)
    else:
        rows, targets = design.rows(), errors
        change = lapack.smallest_solution(rows, targets, _SMALLEST_RCOND)
    return _nearest(rows, targets) if change is None else change


def _nearest(rows: FloatArray, errors: FloatArray) -> FloatArray:
    """Return the smallest change of the coefficients (m, outputs) that explains `errors` (k, outputs), at any rank.

    Iterated Tikhonov: for a singular value σ, each pass leaves the share λ / (σ² + λ) of the remaining error, and
    corrects the rounding of the pass before. Directions with σ² far below λ stay at the prior.
    """
    gram = ShiftedGram((rows @ rows.T).T)
    ridge = _VANISHING_RIDGE * gram.trace
    while not gram.factorise(ridge):
        ridge *= 10.0
    change = rows.T @ gram.solve(errors)
    left = float("inf")
    for _ in range(_REFINEMENTS):
        remaining = errors - rows @ change
        size = float(np.linalg.norm(remaining))
        if not size < 0.5 * left:
            break
        left = size
        change = change + rows.T @ gram.solve(remaining)
    return change
