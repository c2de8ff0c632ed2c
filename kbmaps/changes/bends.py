"""How an arm may bend that is no chain, and how probable that is by pairs between which nothing changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ive  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from kbmaps.arrays import FloatArray, IntArray

# Over how far a bend is much the same [rad of all joints together], how large it is over the noise of a pair, how far a
# joint's own error moves the marker over that noise, and the noise over what it was thought to be: equally probable.
LENGTHS = (0.7, 1.4)
BENDS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
TURNS = (0.0, 0.5, 2.0, 8.0)
NOISES = (0.5, 0.7, 1.0, 1.4)
# What other pairs say of bends of each length where there are none.
NOTHING_SEEN = (0.0,) * len(LENGTHS)
# A joint's own error, as a function of its value alone, is much the same over so far [rad]. So many waves of a turn
# describe it; constant, it is a zero that the belief has.
_OWN_LENGTH, _HARMONICS = 0.7, 3
# Of what is none, the 1-sigma.
_NONE = 1e-3
# A parameter of which nothing is known may be so many times what the belief leaves open.
_OPEN = 1e3
# Those less probable than this by all pairs, were there no change, are left out: even with one they hardly count.
_LEAST = 1e-6


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs of neighbours, which count by their means.

    Attributes:
        angles: of all pairs (n, d) [rad, or for a sliding joint what moves the marker as far].
        starts: the first pair of each run (m,).
        rows: means of the derivatives by what is known, then by joints' own errors, and of errors, times the square
            root of the run's length (m, 3, p).
        known: how many of these are known, with a prior of variance 1.
        within: sum of the squares of errors around their means.
    """

    angles: FloatArray
    starts: IntArray
    rows: FloatArray
    known: int
    within: float

    @classmethod
    def of(
        cls, angles: FloatArray, known: FloatArray, turning: FloatArray, errors: FloatArray, starts: IntArray
    ) -> Runs:
        """Runs of pairs, which begin with these.

        Args:
            known: derivatives by what is known (n, 3, k).
            turning: derivatives by each joint, a joint's own error of 1 (n, 3, d).
            errors: (n, 3).
        """
        lengths = np.diff(np.append(starts, len(angles)))
        rows = np.concatenate([known, _own_errors(angles, turning), errors[..., None]], axis=2)
        means = np.add.reduceat(rows, starts) / lengths[:, None, None]
        within = float(np.square(errors - np.repeat(means[..., -1], lengths, axis=0)).sum())
        return cls(angles, starts, means * np.sqrt(lengths)[:, None, None], known.shape[2], within)

    @property
    def lengths(self) -> FloatArray:
        """How many pairs each run has (m,)."""
        return np.diff(np.append(self.starts, len(self.angles))).astype(np.float64)

    @cached_property
    def axes(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Of bends of each length and of size 1 the variances (m,) along these axes of runs (m, m)."""
        on_circles = np.concatenate([np.cos(self.angles), np.sin(self.angles)], axis=1)
        alike, lengths = on_circles @ on_circles.T - self.angles.shape[1], self.lengths
        found = list[tuple[FloatArray, FloatArray]]()
        for length in LENGTHS:
            kernel = np.exp(alike / length**2)
            summed = np.add.reduceat(np.add.reduceat(kernel, self.starts, axis=0), self.starts, axis=1)
            values, axes = np.linalg.eigh(summed / np.sqrt(lengths * lengths[:, None]))
            found.append((np.maximum(values, 0.0), axes))
        return tuple(found)

    def without_belief(self) -> Runs:
        """The same where nothing of what the belief has is known: it was fitted to these pairs."""
        rows = self.rows.copy()
        rows[..., : self.known] *= _OPEN
        return Runs(self.angles, self.starts, rows, self.known, self.within)


@dataclass(frozen=True, eq=False)
class Bends:
    """Bends of one length, with many sizes, joints' own errors and noises, all of them probable.

    Attributes:
        axes: the coordinates of runs in which each bend is diagonal (m, m).
        weights: over the variance of each coordinate (h, m).
        known: what rows of runs have in common with what is known and joints' own errors (h, k, 3 m).
        logs: how probable each is (h,).
    """

    axes: FloatArray
    weights: FloatArray
    known: FloatArray
    logs: FloatArray

    def sums(self, rows: FloatArray) -> FloatArray:
        """Of products of rows (m, 3, p) of runs, weighed, without what is explained by what is known (h, p, p)."""
        turned = np.tensordot(self.axes.T, rows, axes=1)
        products = np.tensordot(self.weights, turned.transpose(0, 2, 1) @ turned, axes=1)
        common = self.known @ turned.reshape(-1, rows.shape[2])
        return products - common.transpose(0, 2, 1) @ common


def log_evidence(runs: Runs) -> list[FloatArray]:
    """How well bends explain pairs between which nothing changed, for each length (h,).

    The same bends for all runs: each joints' own error with each noise with each size.
    """
    found: list[FloatArray] = []
    alone, known = 1.5 * (len(runs.angles) - len(runs.starts)), runs.rows.shape[2] - 1
    for k, (values, axes) in enumerate(runs.axes):
        weights, noises = _weights(k, values)
        turned = np.tensordot(axes.T, runs.rows, axes=1)
        sums = np.tensordot(weights, turned.transpose(0, 2, 1) @ turned, axes=1)
        logs = 1.5 * np.log(weights).sum(axis=1) - 0.5 * runs.within / noises - alone * np.log(noises)
        # A bend of no size has no length: it stands for as many as there are lengths.
        logs[np.tile(_sizes(k), len(NOISES)) == 0.0] += np.log(len(LENGTHS))
        crossed = sums[:, :known, known:]
        for turn in TURNS:
            prior = _prior(runs, turn)
            precision = sums[:, :known, :known] + np.diag(prior)
            left = sums[:, known:, known:] - crossed.transpose(0, 2, 1) @ np.linalg.solve(precision, crossed)
            volume = np.linalg.slogdet(precision)[1] - np.log(prior).sum()
            found.append(logs - 0.5 * (left[:, 0, 0] + volume))
    return [np.concatenate(found[k * len(TURNS) : (k + 1) * len(TURNS)]) for k in range(len(LENGTHS))]


def probable_bends(runs: Runs, before: Sequence[FloatArray | float]) -> list[Bends]:
    """What is probable by these pairs, if nothing changed, and by what others say (`log_evidence`)."""
    logs = [now + past for now, past in zip(log_evidence(runs), before, strict=True)]
    total = np.logaddexp.reduce(np.concatenate(logs))
    return [_chosen(runs, k, each - total) for k, each in enumerate(logs) if (each - total > np.log(_LEAST)).any()]


def _chosen(runs: Runs, k: int, logs: FloatArray) -> Bends:
    values, axes = runs.axes[k]
    probable = np.flatnonzero(logs > np.log(_LEAST))
    every = _weights(k, values)[0]
    weights = every[probable % len(every)]
    turned = np.tensordot(axes.T, runs.rows[..., :-1], axes=1)
    known = np.empty((len(probable), turned.shape[2], turned.shape[0] * 3))
    for h, (turn, weight) in enumerate(zip(probable // len(every), weights, strict=True)):
        weighed = (turned * weight[:, None, None]).reshape(-1, turned.shape[2])
        precision = weighed.T @ turned.reshape(weighed.shape) + np.diag(_prior(runs, TURNS[turn]))
        known[h] = np.linalg.solve(np.linalg.cholesky(precision), weighed.T)
    return Bends(axes, weights, known, logs[probable])


def _sizes(k: int) -> FloatArray:
    """Of bends of the length number k."""
    return np.array(BENDS if k == 0 else BENDS[1:])


def _weights(k: int, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Over the variances of runs (h, m) for each noise with each size of a bend, and the noises (h,), squared."""
    noises = np.repeat(np.square(NOISES), len(_sizes(k)))
    sizes = np.tile(np.square(_sizes(k)), len(NOISES))
    return 1.0 / (noises[:, None] * (1.0 + sizes[:, None] * values)), noises


def _prior(runs: Runs, turn: float) -> FloatArray:
    """Over the variance (k,) of what is known, and of joints' own errors of this size."""
    own = runs.rows.shape[2] - 1 - runs.known
    return np.r_[np.ones(runs.known), np.full(own, max(turn, _NONE) ** -2.0)]


def _own_errors(angles: FloatArray, turning: FloatArray) -> FloatArray:
    """Derivatives (n, 3, 2 d h) by the waves of each joint's own error, a Gaussian process of variance 1.

    Its kernel exp(−(1 − cos Δ) / ℓ²) has, for the wave n > 0, the share 2 exp(−1 / ℓ²) I_n(1 / ℓ²) with the Bessel
    function I_n.
    """
    columns: list[FloatArray] = []
    for wave in range(1, _HARMONICS + 1):
        share = 2.0 * float(ive(wave, _OWN_LENGTH**-2.0))
        for of_angle in (np.cos, np.sin):
            columns.append(np.sqrt(share) * of_angle(wave * angles)[:, None] * turning)
    return np.concatenate(columns, axis=2)
