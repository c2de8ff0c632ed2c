"""How an arm may bend that is no chain, and how probable that is by pairs between which nothing changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from scipy.special import ive  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from kbmaps.arrays import FloatArray, IntArray

# Over how far a bend is much the same [rad of all joints together], how large it is over the noise of a pair, how far a
# joint's own error moves the marker over that noise, and the noise over what it was thought to be: equally probable,
# but for an arm that has neither bends nor such errors, which is as probable as all others together.
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
# As far as pairs tell to which it was fitted, what is known may be off by so many times what the belief leaves open.
_OPEN = 1e3
# A chain that was fitted to an arm that bends took part of it for its own: the variance of what the belief leaves open
# is more by so many times the square of the bend over the noise.
_TAKEN_ALONG = 3.0
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
        fitted: whether what is known was fitted to these pairs, which then say nothing of it.
    """

    angles: FloatArray
    starts: IntArray
    rows: FloatArray
    known: int
    within: float
    fitted: bool

    @classmethod
    def of(
        cls,
        angles: FloatArray,
        known: FloatArray,
        turning: FloatArray,
        errors: FloatArray,
        starts: IntArray,
        *,
        fitted: bool,
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
        return cls(angles, starts, means * np.sqrt(lengths)[:, None, None], known.shape[2], within, fitted)

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
        crossed = sums[:, :known, known:]
        of_length: list[FloatArray] = []
        for turn in TURNS:
            prior = _prior(runs, k, turn)
            precision = sums[:, :known, :known] + prior[:, None] * np.eye(known)
            left = sums[:, known:, known:] - crossed.transpose(0, 2, 1) @ np.linalg.solve(precision, crossed)
            volume = np.linalg.slogdet(precision)[1] - np.log(prior).sum(axis=1)
            of_length.append(logs - 0.5 * (left[:, 0, 0] + volume))
        found.append(np.concatenate(of_length))
    return found


def probable_bends(runs: Runs, before: Sequence[FloatArray | float]) -> list[Bends]:
    """What is probable by these pairs, if nothing changed, and by what others say (`log_evidence`)."""
    evidence = zip(log_evidence(runs), before, strict=True)
    logs = [now + past + _log_prior(k) for k, (now, past) in enumerate(evidence)]
    total = np.logaddexp.reduce(np.concatenate(logs))
    return [_chosen(runs, k, each - total) for k, each in enumerate(logs) if (each - total > np.log(_LEAST)).any()]


def _chosen(runs: Runs, k: int, logs: FloatArray) -> Bends:
    values, axes = runs.axes[k]
    probable = np.flatnonzero(logs > np.log(_LEAST))
    every = _weights(k, values)[0]
    weights, priors = every[probable % len(every)], np.concatenate([_prior(runs, k, turn) for turn in TURNS])
    turned = np.tensordot(axes.T, runs.rows[..., :-1], axes=1)
    known = np.empty((len(probable), turned.shape[2], turned.shape[0] * 3))
    for h, (prior, weight) in enumerate(zip(priors[probable], weights, strict=True)):
        weighed = (turned * weight[:, None, None]).reshape(-1, turned.shape[2])
        precision = weighed.T @ turned.reshape(weighed.shape) + np.diag(prior)
        known[h] = np.linalg.solve(cast(FloatArray, np.linalg.cholesky(precision)), weighed.T)
    return Bends(axes, weights, known, logs[probable])


def _log_prior(k: int) -> FloatArray:
    """How probable each is before any pair (h,), of those of the length number k; they need not add up to one."""
    sizes, turns = np.tile(_sizes(k), len(TURNS) * len(NOISES)), np.repeat(TURNS, len(NOISES) * len(_sizes(k)))
    # A bend of no size has no length: it stands for as many as there are lengths.
    shares = np.where(sizes == 0.0, float(len(LENGTHS)), 1.0)
    return np.log(np.where(sizes + turns == 0.0, shares * (len(BENDS) * len(TURNS) - 1.0), shares))


def _sizes(k: int) -> FloatArray:
    """Of bends of the length number k."""
    return np.array(BENDS if k == 0 else BENDS[1:])


def _weights(k: int, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Over the variances of runs (h, m) for each noise with each size of a bend, and the noises (h,), squared."""
    noises = np.repeat(np.square(NOISES), len(_sizes(k)))
    sizes = np.tile(np.square(_sizes(k)), len(NOISES))
    return 1.0 / (noises[:, None] * (1.0 + sizes[:, None] * values)), noises


def _prior(runs: Runs, k: int, turn: float) -> FloatArray:
    """Over the variance (h, p) of what is known, and of joints' own errors of this size, with each noise and bend."""
    squares = np.tile(np.square(_sizes(k)), len(NOISES)) + turn**2
    left_open = np.full(len(squares), _OPEN**2) if runs.fitted else 1.0 + _TAKEN_ALONG * squares
    known = np.repeat(1.0 / left_open[:, None], runs.known, axis=1)
    own = np.full((len(known), runs.rows.shape[2] - 1 - runs.known), max(turn, _NONE) ** -2.0)
    return np.concatenate([known, own], axis=1)


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
