"""What has no name beside what has: families of linear functions that compete with the named effects.

So an effect is not named where something else is at work.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from interfaces.records import FloatArray

from .families import families
from .fit import Fit
from .held_out import Blocks, scores_p_value
from .search import nats

# What has no name has to be so much more probable than what has one [nats].
_NO_NAME = 8.0
# What one of its numbers costs [nats].
_NUMBER = 2.0
# Directions of a family's columns of which less is left, as a share of the strongest and of the whole, tell nothing.
_TOLD, _LEFT = 1e-6, 1e-7
# Whether blocks of time agree is asked of so many of a family's directions.
_STRONGEST = 4
_RIDGE = 1e-6


class Unknowns:
    """All families as they stand beside fits of the same observations.

    Their columns are those of the aligned simulation: what is unknown is small, and so is what the causes change.
    """

    def __init__(self, start: Fit) -> None:
        self.families = families(start.run)
        columns = [start.observations.whitened(family.columns(start.run)) for family in self.families]
        ends = np.cumsum([part.shape[2] for part in columns])
        self._slices = [slice(end - part.shape[2], end) for end, part in zip(ends, columns, strict=True)]
        self._columns = np.concatenate(columns, axis=2).reshape(start.left.size, -1)
        self._scales = np.maximum(np.linalg.norm(self._columns, axis=0), 1e-300)
        self._columns /= self._scales
        self._doubt = float(np.log(len(self.families))) + _NO_NAME

    def beside(self, fit: Fit, others: Sequence[int] = ()) -> tuple[FloatArray, FloatArray]:
        """An orthonormal basis (3 n, r) of what `fit` and some families can change, and what they leave (3 n,)."""
        basis = fit.orthogonal.reshape(fit.left.size, -1)
        for index in others:
            basis = np.concatenate([basis, self._fresh(fit, basis, index)], axis=1)
        left = fit.left.ravel()
        return basis, left - basis @ (basis.T @ left)

    def best(self, fit: Fit, others: Sequence[int] = ()) -> tuple[int, float]:
        """The family that is worth most beside a fit and other families, and how much [nats]."""
        basis, left = self.beside(fit, others)
        weights = np.repeat(fit.root_weights[:, 0], 3)
        columns = self._columns * weights[:, None]
        onto, toward = basis.T @ columns, columns.T @ left
        rss, rows = float(left @ left), float(fit.noise.weights.sum())
        worths = []
        for part in self._slices:
            own = columns[:, part]
            inner = own.T @ own - onto[:, part].T @ onto[:, part]
            values, vectors = np.linalg.eigh(inner)
            told = values > _TOLD * max(float(values.max()), 1e-12)
            told &= values > _LEFT
            explained = float(np.square(vectors[:, told].T @ toward[part] / np.sqrt(values[told])).sum())
            gain = -3.0 * rows * float(np.log1p(-min(explained / rss, 0.999999)))
            worths.append(0.5 * gain - _NUMBER * int(told.sum()))
        index = int(np.argmax(worths))
        return index, worths[index] - self._doubt

    def gain(self, fit: Fit, chosen: Sequence[int]) -> tuple[float, int]:
        """Twice the log-likelihood that families bring beside a fit, and with how many numbers."""
        before = fit.left.ravel() - fit.orthogonal.reshape(fit.left.size, -1) @ (
            fit.orthogonal.reshape(fit.left.size, -1).T @ fit.left.ravel()
        )
        basis, after = self.beside(fit, chosen)
        rows = float(fit.noise.weights.sum())
        share = float(after @ after) / max(float(before @ before), 1e-300)
        return -3.0 * rows * float(np.log(max(share, 1e-12))), basis.shape[1] - fit.orthogonal.shape[2]

    def size(self, fit: Fit, chosen: Sequence[int]) -> float:
        """How much families explain (RMS) of what a fit leaves, in units of the stated noise."""
        basis, _ = self.beside(fit, chosen)
        own = basis[:, fit.orthogonal.shape[2] :]
        return float(np.sqrt(np.square(own.T @ fit.left.ravel()).sum() / fit.left.size))

    def predicted(self, fit: Fit, chosen: Sequence[int], blocks: Blocks) -> tuple[FloatArray, FloatArray]:
        """What families predict of what a fit leaves (n, 3) [m]: of all rows, and of rows that were not fitted."""
        basis, _ = self.beside(fit, chosen)
        own = basis[:, fit.orthogonal.shape[2] :]
        left = fit.left.ravel()
        explained = own @ (own.T @ left)
        held_out = np.zeros_like(left)
        folds = np.repeat(blocks.fold, 3)
        for fold in np.unique(folds):
            rows = folds == fold
            inner = basis[~rows].T @ basis[~rows] + _RIDGE * np.eye(basis.shape[1])
            amounts = np.linalg.solve(inner, basis[~rows].T @ left[~rows])
            held_out[rows] = basis[rows] @ amounts
        weights = np.maximum(fit.root_weights, 1e-6)[:, :, None]
        both = np.stack([explained, held_out], axis=1).reshape(*fit.left.shape, 2) / weights
        metres = np.asarray(np.linalg.solve(fit.observations.whitening, both), dtype=np.float64)
        return metres[:, :, 0], metres[:, :, 1]

    def numbers(self, fit: Fit, chosen: Sequence[int]) -> list[FloatArray]:
        """The numbers of families, each (p,), that explain most of what a fit leaves."""
        basis = fit.orthogonal.reshape(fit.left.size, -1)
        weights = np.repeat(fit.root_weights[:, 0], 3)[:, None]
        columns = np.concatenate([self._columns[:, self._slices[index]] for index in chosen], axis=1) * weights
        columns = columns - basis @ (basis.T @ columns)
        solved = np.linalg.lstsq(columns, fit.left.ravel(), rcond=float(np.sqrt(_LEFT)))[0]
        parts = np.split(solved, np.cumsum([self._columns[:, self._slices[index]].shape[1] for index in chosen])[:-1])
        return [part / self._scales[self._slices[index]] for part, index in zip(parts, chosen, strict=True)]

    def agreed(self, fit: Fit, others: Sequence[int], index: int) -> float:
        """What a family is worth by the agreement of blocks of time [nats]."""
        basis, left = self.beside(fit, others)
        fresh = self._fresh(fit, basis, index)
        strongest = np.argsort(-np.abs(fresh.T @ left))[:_STRONGEST]
        columns = fresh[:, strongest].reshape(*fit.left.shape, -1)
        chance = scores_p_value(columns, left.reshape(fit.left.shape), Blocks.cut(len(fit.left)))
        # The strongest of so many were chosen: each costs as one among all.
        gain = float(stats.chi2.isf(max(chance, 1e-290), len(strongest)))
        return nats(gain, len(strongest)) - len(strongest) * float(np.log(fresh.shape[1])) - self._doubt

    def _fresh(self, fit: Fit, basis: FloatArray, index: int) -> FloatArray:
        """An orthonormal basis (3 n, r) of what a family changes beside a basis."""
        columns = self._columns[:, self._slices[index]] * np.repeat(fit.root_weights[:, 0], 3)[:, None]
        columns = columns - basis @ (basis.T @ columns)
        left, values, _ = np.linalg.svd(columns, full_matrices=False)
        return left[:, values > np.sqrt(_LEFT)]
