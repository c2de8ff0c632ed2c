"""Predict held-out blocks of time.

A fit without a block differs from the full one by a Newton step, so no model is fitted twice. With H the information
of the other blocks and g the gradient of the block's own likelihood, the amounts move by -H⁻¹ g.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import fdtrc

from bodyschema.diagnosis.fit.fit import Fit, FitSettings, solved
from bodyschema.diagnosis.fit.observations import IntArray
from bodyschema.diagnosis.fit.scatter import instruments
from bodyschema.diagnosis.fit.tangent import TangentSettings
from bodyschema.interfaces.records import FloatArray

from .scan import Candidate


class HeldOutSettings:
    """Settings of held-out prediction.

    Sensitivity, each at 0.3 and 3 times over three recordings: `folds` and the rows of a block change probabilities by
    0.005, gains by 2 %, and gains of rejected causes by their own size; `bootstraps` and `long_blocks` the ends of the
    gain's interval; with `marker` above 1 no fix is left. Other `most_blocks` were not measured.
    """

    max_blocks, folds = 80, 5  # of time; blocks are dealt to the folds in turn
    # Neighbours in time are alike for long, so a gain's interval rests on this many long parts of a recording.
    bootstraps, long_blocks = 2000, 10
    marker = 0.5  # a fix that is less probably the marker is left out of all figures
    min_rows_a_block = 5


@dataclass(frozen=True, eq=False)
class Blocks:
    """Assignment of rows to blocks of time."""

    of_row: IntArray  # the block of each row (n,)
    count: int  # number of blocks

    @classmethod
    def cut(cls, rows: int, most: int = HeldOutSettings.max_blocks) -> Blocks:
        """Cut rows into blocks of equal length, as many as reasonable."""
        count = int(np.clip(rows // HeldOutSettings.min_rows_a_block, HeldOutSettings.folds, most))
        return cls(np.arange(rows) * count // max(rows, 1), count)

    @property
    def fold(self) -> IntArray:
        """Fold of each row (n,)."""
        return self.of_row % HeldOutSettings.folds

    def merged(self, most: int) -> Blocks:
        """Return at most `most` longer blocks of neighbouring blocks."""
        count = min(self.count, most)
        return Blocks(self.of_row * count // self.count, count)

    def sums(self, values: FloatArray) -> FloatArray:
        """Return sums (blocks, ...) of values (n, ...)."""
        columns = values.reshape(len(values), -1).T
        sums = [np.bincount(self.of_row, column, self.count) for column in columns]
        return np.array(sums, dtype=np.float64).T.reshape(self.count, *values.shape[1:])


def held_out_errors(fit: Fit, blocks: Blocks) -> FloatArray:
    """Return measured minus predicted (n, 3) [m], each row predicted without its own fold."""
    errors = fit.observations.x - fit.predicted
    if not len(fit.precision):
        return errors
    precision = np.diag(fit.precision) * fit.noise.sigma**2
    derivatives, products = fit.derivatives, _Products.of(fit, fit.columns, blocks)
    total_inner, total_rhs = products.inner.sum(axis=0), products.rhs.sum(axis=0)
    for fold, (inner, rhs) in enumerate(zip(products.inner, products.rhs, strict=True)):
        own = blocks.fold == fold
        errors[own] -= derivatives[own] @ solved(total_inner - inner + precision, total_rhs - rhs)
    return errors


def gain_percent(before: FloatArray, after: FloatArray, blocks: Blocks, seed: int) -> tuple[float, tuple[float, float]]:
    """Return the reduction of the RMS of distances (n,) [%], and its 95 % interval on new poses.

    The interval is for another recording of the same kind, half as long: as many long blocks as it would have are
    resampled from this recording, which is itself a sample.
    """
    blocks = blocks.merged(HeldOutSettings.long_blocks)
    rows = blocks.sums(np.stack([np.square(before), np.square(after)], axis=1))
    rows = rows[rows[:, 0] > 0.0]  # the others have no fix that counts
    if not len(rows):
        return 0.0, (0.0, 0.0)
    count, total = len(rows), rows.sum(axis=0)
    rng = np.random.default_rng(seed)
    again = rng.integers(count, size=(HeldOutSettings.bootstraps, count))
    other = rng.integers(count, size=(HeldOutSettings.bootstraps, max(count // 2, 1)))
    sums = rows[np.take_along_axis(again, other, axis=1)].sum(axis=1)

    def percent(before_after: FloatArray) -> FloatArray:
        return 100.0 * (1.0 - np.sqrt(before_after[..., 1] / before_after[..., 0]))

    low, high = np.quantile(percent(sums), [0.025, 0.975])
    return float(percent(total)), (float(low), float(high))


@dataclass(frozen=True, slots=True)
class HeldOutGain:
    """Gain by one more hypothesis on held-out data."""

    held_out_gain_percent: float  # reduction of the squared error on held-out rows
    p_value: float  # p-value of no gain, from the agreement of blocks, for this hypothesis alone


def held_out_gains(fit: Fit, candidates: Sequence[Candidate], blocks: Blocks) -> list[HeldOutGain]:
    """Return the first-order gain of each candidate on top of a fit."""
    effects = [candidate.effect for candidate in candidates]
    fresh = np.concatenate(
        [np.empty((*fit.weighted_residuals.shape, 0)), *(instruments(fit, one) for one in effects)], axis=2
    )
    ends = np.cumsum([0, *(len(one.amounts) for one in effects)])
    groups = [np.arange(first, end) for first, end in pairwise(ends)]
    usual = [FitSettings.largest * one.parameters[j].usual for one in effects for j in one.amounts]
    products = _Products.of(fit, np.concatenate([fit.columns, fresh], axis=2), blocks)
    precision = np.append(fit.precision, 1.0 / np.square(np.array(usual)))
    before, *after = products.held_out_squares(precision, len(fit.precision), [np.arange(0), *groups]).tolist()
    orthogonal = orthogonal_to_fit(fit, fresh)
    return [
        HeldOutGain(
            100.0 * (1.0 - held_out_squares / before if before > 0.0 else 0.0),
            _p_value(fit, orthogonal[:, :, own], blocks),
        )
        for held_out_squares, own in zip(after, groups, strict=True)
    ]


def held_out_square(fit: Fit, columns: FloatArray, precision: FloatArray, blocks: Blocks) -> float:
    """Return the sum of squared held-out residuals of a fit after adding columns (n, 3, p)."""
    return float(_Products.of(fit, columns, blocks).held_out_squares(precision, len(precision), [np.arange(0)])[0])


@dataclass(frozen=True, eq=False)
class _Products:
    """Products of columns with one another and with the residuals of a fit, fold by fold."""

    # inner, toward: (folds, p, p) and (folds, p)
    inner: FloatArray
    rhs: FloatArray
    square: float  # sum of squares of all residuals
    variance: float  # noise variance, in units of the stated one

    @classmethod
    def of(cls, fit: Fit, columns: FloatArray, blocks: Blocks) -> _Products:
        """Form the products of columns (n, 3, p)."""
        rows = []
        for fold in range(HeldOutSettings.folds):
            own = np.flatnonzero(blocks.fold == fold)
            rows.append((columns[own].reshape(3 * len(own), columns.shape[2]), fit.weighted_residuals[own].ravel()))
        inner, rhs = np.array([c.T @ c for c, _ in rows]), np.array([c.T @ left for c, left in rows])
        return cls(inner, rhs, float(np.square(fit.weighted_residuals).sum()), fit.noise.sigma**2)

    def held_out_squares(self, precision: FloatArray, first: int, groups: Sequence[IntArray]) -> FloatArray:
        """Return sums (m,) of squared held-out residuals with the first columns and each of some groups of the others.

        Args:
            precision: prior precision of all amounts (p,).
            groups: indices (k,) among the columns after the first ones.
        """
        squares = np.full(len(groups), self.square)
        total_inner, total_rhs = self.inner.sum(axis=0) + np.diag(precision) * self.variance, self.rhs.sum(axis=0)
        for inner, rhs in zip(self.inner, self.rhs, strict=True):
            normal, wanted = total_inner - inner, total_rhs - rhs
            cross = normal[:first, first:]
            # Projection of each of the others onto the first columns, and their own amounts.
            followed = solved(normal[:first, :first], np.column_stack([cross, wanted[:first]]))
            others, alone = followed[:, :-1], followed[:, -1]
            left, sought = normal[first:, first:] - cross.T @ others, wanted[first:] - cross.T @ alone
            for k, own in enumerate(groups):
                more = solved(left[np.ix_(own, own)], sought[own])
                places = np.append(np.arange(first), first + own)
                step = np.append(alone - others[:, own] @ more, more)
                squares[k] += step @ (inner[np.ix_(places, places)] @ step - 2.0 * rhs[places])
        return squares


def block_p_value(fit: Fit, columns: FloatArray, blocks: Blocks) -> float:
    """Return the p-value that columns (n, 3, k) explain nothing of the residuals, from the agreement of blocks.

    The noise of the scores comes from the blocks' own scores, with the columns fitted. So it is right even if
    neighbouring rows are correlated, as when a joint stands still and is rounded the same way repeatedly (Liang and
    Zeger 1986; Hotelling's T² for few blocks).
    """
    return _p_value(fit, orthogonal_to_fit(fit, columns), blocks)


def orthogonal_to_fit(fit: Fit, columns: FloatArray) -> FloatArray:
    """Return the part of columns (n, 3, k) orthogonal to a fit, `fully_whitened`."""
    flat = fit.fully_whitened(columns.reshape(fit.weighted_residuals.size, -1))
    basis = fit.effect_basis.reshape(fit.weighted_residuals.size, -1)
    return (flat - basis @ (basis.T @ flat)).reshape(columns.shape)


def _p_value(fit: Fit, orthogonal: FloatArray, blocks: Blocks) -> float:
    """Return the `block_p_value` of columns from their part orthogonal to the fit (n, 3, k)."""
    flat = orthogonal.reshape(fit.weighted_residuals.size, -1)
    inner = flat.T @ flat
    scales = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    values, vectors = np.linalg.eigh(inner / np.outer(scales, scales))
    identifiable = values > TangentSettings.told_apart
    k = int(identifiable.sum())
    if not 0 < k < blocks.count:
        return 1.0
    # For orthonormal columns, the scores are the best-fitting amounts.
    orthogonal = orthogonal @ (vectors[:, identifiable] / np.sqrt(values[identifiable]) / scales[:, None])
    return scores_p_value(orthogonal, fit.whitened_residuals, blocks)


def scores_p_value(columns: FloatArray, left: FloatArray, blocks: Blocks) -> float:
    """Return the p-value of `block_p_value` for orthonormal columns (n, 3, k) and residuals `left` (n, 3)."""
    k = columns.shape[2]
    scores = np.einsum("nik,ni->nk", columns, left)
    total = scores.sum(axis=0)
    fitted = scores - np.einsum("nik,ni->nk", columns, columns @ total)
    spread = blocks.sums(fitted)
    spread = spread.T @ spread * blocks.count / (blocks.count - 1.0)
    statistic = float(total @ np.linalg.lstsq(spread, total, rcond=1e-12)[0])
    return float(fdtrc(k, blocks.count - k, max(statistic, 0.0) * (blocks.count - k) / (k * (blocks.count - 1.0))))


def is_marker(fit: Fit) -> np.ndarray:
    """Return True for trusted fixes (n,) that are probably the marker."""
    return fit.noise.weights >= HeldOutSettings.marker
