"""What has no name beside what has: families of linear functions that compete with the named effects.

So an effect is not named where something else is at work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from interfaces.records import FloatArray

from .families import Family, families
from .fit import Fit, fitted, prior_precision, solved
from .held_out import Blocks, held_out_square, scores_p_value
from .observations import Observations
from .search import nats

# What has no name has to be so much more probable than what has one [nats].
_NO_NAME = 8.0
# What one of its numbers costs [nats].
_NUMBER = 2.0
# Directions of a family's columns of which less is left, as a share of the strongest and of the whole, tell nothing.
_TOLD, _LEFT = 1e-6, 1e-7
# Whether blocks of time agree is asked of so many of a family's directions.
_STRONGEST = 4
# Rounds in which families and causes are fitted in turn, until the likelihood rises by less than this [nats].
_ROUNDS, _ENOUGH = 5, 0.1


@dataclass(frozen=True, eq=False)
class Apart:
    """A fit to what is left of the observations when families have taken away what they account for.

    Attributes:
        observations: all that was observed.
        chosen: which families.
        numbers: of each of them (p,).
        fit: of the causes.
        ridge: on the families' numbers, in units in which their columns are as long as one.
    """

    observations: Observations
    chosen: tuple[int, ...]
    numbers: tuple[FloatArray, ...]
    fit: Fit
    ridge: float

    @property
    def predicted(self) -> FloatArray:
        """What is measured (n, 3) [m] by causes and families together."""
        return self.fit.run.measured + (self.observations.x - self.fit.observations.x)


def _unit_columns(start: Fit, family: Family) -> tuple[FloatArray, FloatArray]:
    """A family's columns (3 n, p), whitened and made as long as one, and how long they were (p,)."""
    columns = start.observations.whitened(family.columns(start.run)).reshape(start.left.size, -1)
    scales = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    columns /= scales
    return columns, scales


class Unknowns:
    """All families as they stand beside fits of the same observations.

    Their columns are those of the aligned simulation: what is unknown is small, and so is what the causes change.
    """

    def __init__(self, start: Fit) -> None:
        self.families, self._run = families(start.run), start.run
        units = [_unit_columns(start, family) for family in self.families]
        self._columns, self._scales = [columns for columns, _ in units], [scales for _, scales in units]
        self._doubt = float(np.log(len(self.families))) + _NO_NAME

    def beside(self, fit: Fit, others: Sequence[int] = ()) -> tuple[FloatArray, FloatArray]:
        """An orthonormal basis (3 n, r) of what `fit` and some families can change, and what they leave (3 n,)."""
        basis = fit.orthogonal.reshape(fit.left.size, -1)
        for index in others:
            basis = np.concatenate([basis, self._fresh(fit, basis, index)], axis=1)
        left = fit.left.ravel()
        return basis, left - basis @ (basis.T @ left)

    def ranked(self, fit: Fit, others: Sequence[int] = ()) -> list[tuple[int, float]]:
        """The families by what they are worth beside a fit and others, to first order [nats], the best first."""
        basis, left = self.beside(fit, others)
        weights = np.repeat(fit.root_weights[:, 0], 3)[:, None]
        rss, rows = float(left @ left), float(fit.noise.weights.sum())
        worths = []
        for columns in self._columns:
            own = columns * weights
            onto, toward = basis.T @ own, own.T @ left
            inner = own.T @ own - onto.T @ onto
            values, vectors = np.linalg.eigh(inner)
            told = values > _TOLD * max(float(values.max()), 1e-12)
            told &= values > _LEFT
            explained = float(np.square(vectors[:, told].T @ toward / np.sqrt(values[told])).sum())
            gain = -3.0 * rows * float(np.log1p(-min(explained / rss, 0.999999)))
            worths.append(0.5 * gain - _NUMBER * int(told.sum()))
        order = np.argsort(worths)[::-1]
        return [(int(index), worths[index] - self._doubt) for index in order]

    def apart(self, fit: Fit, chosen: Sequence[int], start: Apart | None = None) -> Apart:
        """The causes of a fit and families, fitted in turn to what the others leave.

        A joint that errs is turned in the readings, so that large errors are as exact as small ones.

        Args:
            start: with some of the families.
        """
        known = {} if start is None else dict(zip(start.chosen, start.numbers, strict=True))
        numbers = tuple(known.get(index, np.zeros(self._columns[index].shape[1])) for index in chosen)
        # No function is expected to be larger than twice all that is left.
        ridge = 0.25 * fit.noise.sigma**2 / max(float(np.square(fit.left).sum()), 1e-300)
        here = Apart(fit.observations, tuple(chosen), numbers, fit if start is None else start.fit, ridge)
        for _ in range(_ROUNDS):
            numbers = self._step(here)
            left = self._without(fit.observations, chosen, numbers)
            tried = fitted(left, here.fit.simulation, fit.nuisances, here.fit.noise)
            rise = tried.log_likelihood - here.fit.log_likelihood
            if rise > 0.0:
                here = replace(here, numbers=numbers, fit=tried)
            if rise < _ENOUGH:
                break
        return here

    def cost(self, apart: Apart) -> float:
        """What the families and their numbers cost [nats]."""
        return len(apart.chosen) * self._doubt + _NUMBER * self.told(apart).shape[2]

    def told(self, apart: Apart) -> FloatArray:
        """What families can change beside the causes (n, 3, r) [m], in directions that the data tell."""
        fit = apart.fit
        columns = np.concatenate([self._columns[index] for index in apart.chosen], axis=1)
        basis = fit.orthogonal.reshape(fit.left.size, -1)
        weighted = columns * np.repeat(fit.root_weights[:, 0], 3)[:, None]
        _, values, mix = np.linalg.svd(weighted - basis @ (basis.T @ weighted), full_matrices=False)
        there = values > np.sqrt(_LEFT)
        directions = (columns @ (mix[there].T / values[there])).reshape(*fit.left.shape, -1)
        return np.asarray(np.linalg.solve(fit.observations.whitening, directions), dtype=np.float64)

    def missed(self, fit: Fit, apart: Apart | None = None) -> float:
        """Mean square of what causes, and families, leave of rows that they were not fitted to, whitened."""
        fit = fit if apart is None else apart.fit
        columns, precision = fit.columns, prior_precision(fit.simulation, fit.nuisances)
        if apart is not None:
            more = fit.weighted(self.told(apart))
            columns = np.concatenate([columns, more], axis=2)
            precision = np.append(precision, np.full(more.shape[2], apart.ridge / fit.noise.sigma**2))
        square = held_out_square(fit, columns, precision, Blocks.cut(len(fit.observations)))
        return square / max(float(fit.noise.weights.sum()), 1.0)

    def _step(self, here: Apart) -> tuple[FloatArray, ...]:
        """The numbers of families that explain most of what the causes leave and are not larger than they can be."""
        fit, counts = here.fit, [len(number) for number in here.numbers]
        basis = fit.orthogonal.reshape(fit.left.size, -1)
        weights = np.repeat(fit.root_weights[:, 0], 3)[:, None]
        columns = np.concatenate([self._columns[index] for index in here.chosen], axis=1) * weights
        columns = columns - basis @ (basis.T @ columns)
        scales = np.concatenate([self._scales[index] for index in here.chosen])
        before = np.concatenate(here.numbers) * scales
        normal = columns.T @ columns + here.ridge * np.eye(len(before))
        step = solved(normal, columns.T @ fit.left.ravel() - here.ridge * before)
        return tuple(np.split((before + step) / scales, np.cumsum(counts)[:-1]))

    def _without(
        self, observations: Observations, chosen: Sequence[int], numbers: Sequence[FloatArray]
    ) -> Observations:
        """Without what families account for: a joint's error in the readings, all else in the positions."""
        q, x = observations.motion.q.copy(), observations.x.copy()
        for index, own in zip(chosen, numbers, strict=True):
            family = self.families[index]
            if family.kind == "joint":
                q[:, family.joint] += family.moved_by(self._run, own)[:, 0]
            else:
                x -= family.columns(self._run) @ own
        return replace(observations, motion=replace(observations.motion, q=q), x=x)

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
        columns = self._columns[index] * np.repeat(fit.root_weights[:, 0], 3)[:, None]
        columns = columns - basis @ (basis.T @ columns)
        left, values, _ = np.linalg.svd(columns, full_matrices=False)
        return left[:, values > np.sqrt(_LEFT)]
