"""Take Gauss-Newton steps, with derivatives and their products that are kept while a fit moves little."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import get_lapack_funcs

from bodyschema.effects import Effect
from bodyschema.interfaces.records import FloatArray

from .background import Background


class TangentSettings:
    # Columns of unit length with a smaller part beside the others are collinear, for a Cholesky factor [squared
    # length].
    collinear = 1e-11
    # A column that keeps a smaller share of its squares beside the others is not identifiable: it is of their rounding.
    told_apart = 1e-7
    singular = 1e-12  # relative size below which an eigenvalue of normal equations is rounding


dpotrf, dpotrs = get_lapack_funcs(("potrf", "potrs"), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Tangent:
    """Derivatives of the predictions about one fit, and their products with one another."""

    effects: tuple[Effect, ...]  # all effects of the fit
    # derivatives (3 n, k) by the amounts, periods and time constants of each effect, whitened
    columns: tuple[FloatArray, ...]
    background: Background  # changes that the tolerances allow
    weights: FloatArray  # of the rows (n,) in the products
    normal: FloatArray  # products (p, p) of the columns of all effects, then of the tolerances

    @classmethod
    def of(
        cls,
        effects: Sequence[Effect],
        columns: Sequence[FloatArray],
        background: Background,
        weights: FloatArray,
        near: Tangent | None = None,
    ) -> Tangent:
        """Form the products; those of columns that `near` contains are taken from it."""
        if near is not None:
            weights = near.weights
        ends = np.cumsum([0, *(own.shape[1] for own in columns)])
        spans = [np.arange(first, end) for first, end in pairwise(ends)]
        tolerances = np.arange(ends[-1], ends[-1] + len(background.tolerances))
        known = {} if near is None else near.known
        # Indices of the common columns here and in `near`.
        shared = [(spans[k], known[id(own)]) for k, own in enumerate(columns) if id(own) in known]
        is_same = near is not None and near.background is background
        if near is not None and is_same:
            shared.append((tolerances, np.arange(len(near.normal) - len(tolerances), len(near.normal))))
        normal = np.empty((ends[-1] + len(tolerances),) * 2)
        if near is not None and shared:
            here, there = (np.concatenate(places) for places in zip(*shared, strict=True))
            normal[np.ix_(here, here)] = near.normal[np.ix_(there, there)]
        flat = np.concatenate([np.empty((3 * len(weights), 0)), *columns], axis=1)
        fresh = [span for span, own in zip(spans, columns, strict=True) if id(own) not in known]
        rows = np.repeat(weights, 3)[:, None]
        if fresh:
            some = np.concatenate(fresh)
            weighted = flat[:, some] * rows
            products = weighted.T @ flat
            normal[some, : ends[-1]], normal[: ends[-1], some] = products, products.T
            across = weighted.T @ background.white
            normal[np.ix_(some, tolerances)], normal[np.ix_(tolerances, some)] = across, across.T
        if not is_same:
            across = (flat * rows).T @ background.white
            normal[: ends[-1], tolerances], normal[tolerances, : ends[-1]] = across, across.T
            normal[np.ix_(tolerances, tolerances)] = background.inner(weights)
        return cls(tuple(effects), tuple(columns), background, weights, normal)

    @property
    def known(self) -> dict[int, np.ndarray]:
        """Places in `normal` of each of the columns, by their identity."""
        ends = np.cumsum([0, *(own.shape[1] for own in self.columns)])
        return {id(own): np.arange(a, b) for own, (a, b) in zip(self.columns, pairwise(ends), strict=True)}

    def gradient(self, left: FloatArray) -> FloatArray:
        """Return the products (p,) of all columns with weighted residuals (n, 3)."""
        flat = left.ravel()
        return np.concatenate([*(own.T @ flat for own in self.columns), self.background.white.T @ flat])


def solved(normal: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return the (shortest) solution (p, ...) of normal equations, with columns scaled to equal length."""
    if not len(gradient):
        return gradient
    scales = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled, wanted = normal / np.outer(scales, scales), (gradient.T / scales).T
    factor, failed = dpotrf(scaled, lower=True)
    if not failed and np.square(np.diag(factor)).min(initial=1.0) > TangentSettings.collinear:
        return (dpotrs(factor, wanted, lower=True)[0].T / scales).T
    # The singular value decomposition of such a matrix need not converge.
    values, vectors = np.linalg.eigh(scaled)
    there = np.abs(values) > TangentSettings.singular * np.abs(values).max()
    inverse = vectors[:, there] / values[there]
    return ((inverse @ (vectors[:, there].T @ wanted)).T / scales).T
