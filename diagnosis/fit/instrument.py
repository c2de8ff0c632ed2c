"""Estimate the instrument's noise beside the encoders' quantisation."""

from __future__ import annotations

import numpy as np

from .fit import Fit

# Factors by which the stated noise may be wrong.
_FACTORS = np.geomspace(0.05, 20.0, 61)


def instrument_factor(fit: Fit) -> float:
    """Return the most probable factor on the stated standard deviations, given the residuals and the quantisation."""
    observations = fit.observations
    rows = fit.noise.weights >= 0.5
    left = (observations.x - fit.predicted)[rows]
    stated, rounding = observations.stated[rows], observations.rounding[rows]
    if not rounding.any():
        return observations.stated_factor
    # Diagonalise both: with V stated Vᵀ = I and V rounding Vᵀ = diag(r), each coordinate has the variance f² + r.
    root = np.linalg.inv(np.linalg.cholesky(stated))
    shares, axes = np.linalg.eigh(root @ rounding @ np.swapaxes(root, 1, 2))
    squares = np.square(np.einsum("nji,njk,nk->ni", axes, root, left)).ravel()
    variances = np.square(_FACTORS)[:, None] + np.maximum(shares, 0.0).ravel()
    likelihood = -0.5 * (np.log(variances) + squares / variances).sum(axis=1)
    return float(_FACTORS[int(np.argmax(likelihood))])
