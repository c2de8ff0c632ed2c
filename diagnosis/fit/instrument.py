"""Estimate the size and the shape of the instrument's noise, in addition to the encoders' quantisation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .fit import Fit
from .observations import Observations


class _Settings:
    factors = np.geomspace(0.05, 20.0, 61)  # factors by which the stated noise may be wrong
    # Beyond this share of coordinates with more quantisation than noise, the residuals do not show the noise's shape.
    mostly_rounding = 0.5


def reshaped(fit: Fit) -> Observations | None:
    """Return the observations with the noise shape estimated from the residuals; None if the stated shape is adequate.

    A stereo camera states that depth is least accurate. If its noise is in truth isotropic, the other directions are
    trusted too much, and chance in these looks like a cause.
    """
    observations, rows = fit.observations, fit.noise.weights >= 0.5
    variances, axes = np.linalg.eigh(observations.stated)
    if np.allclose(variances[:, 0], variances[:, 2]):
        # No shape is stated, and few rows with many parameters do not determine one.
        return None
    residuals = np.einsum("nji,nj->ni", axes, observations.x - fit.predicted)[rows]
    rounding = np.einsum("nji,njk,nki->ni", axes, observations.rounding, axes)[rows]
    stated = observations.stated_factor**2 * variances[rows]
    if (rounding > stated).mean() > _Settings.mostly_rounding:
        return None
    factors = (np.square(residuals) / (stated + rounding)).mean(axis=0)
    count = fit.independence * float(rows.sum())
    # Evidence of three sizes over one, minus the cost of two more parameters (Schwarz 1978).
    gained = 0.5 * count * float(3.0 * np.log(factors.mean()) - np.log(factors).sum())
    if gained < np.log(3.0 * count):
        return None
    scaled = variances * factors / np.exp(np.log(factors).mean())
    return replace(observations, stated=(axes * scaled[:, None, :]) @ np.swapaxes(axes, 1, 2))


def instrument_factor(fit: Fit) -> float:
    """Return the most probable factor on the stated standard deviations, given the residuals and the quantisation."""
    observations = fit.observations
    rows = fit.noise.weights >= 0.5
    residuals = (observations.x - fit.predicted)[rows]
    stated, rounding = observations.stated[rows], observations.rounding[rows]
    if not rounding.any():
        return observations.stated_factor
    # Diagonalise both: with V stated Vᵀ = I and V rounding Vᵀ = diag(r), each coordinate has the variance f² + r.
    root = np.linalg.inv(np.linalg.cholesky(stated))
    shares, axes = np.linalg.eigh(root @ rounding @ np.swapaxes(root, 1, 2))
    squares = np.square(np.einsum("nji,njk,nk->ni", axes, root, residuals)).ravel()
    variances = np.square(_Settings.factors)[:, None] + np.maximum(shares, 0.0).ravel()
    likelihood = -0.5 * (np.log(variances) + squares / variances).sum(axis=1)
    return float(_Settings.factors[int(np.argmax(likelihood))])
