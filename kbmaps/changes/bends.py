"""Deflections (bends) of an arm that a rigid chain lacks, and their evidence in pairs without a change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from scipy.special import ive  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.changes.kinds import log_ratios
from kbmaps.robust import RobustSettings


class BendSettings:
    # Correlation length of a bend [rad of all joints together], its size over the noise of a pair, the marker's motion
    # from a joint's own error over that noise, and the noise over its nominal value. All are equally probable, except
    # an arm without bends and such errors, which is as probable as all others together.
    lengths: tuple[float, ...] = (0.7, 1.4)
    bends: tuple[float, ...] = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
    turns: tuple[float, ...] = (0.0, 0.5, 2.0, 8.0)
    noises: tuple[float, ...] = (0.5, 0.7, 1.0, 1.4)
    # Correlation length of a joint's own error over its value [rad], and the number of harmonics that describe it. A
    # constant error is a joint offset, which the belief includes.
    own_length: float = 0.7
    harmonics: int = 3
    # For pairs to which the belief was fitted, the known parameters may be off by this multiple of the belief's
    # uncertainty.
    open: float = 1e3
    # A chain fitted to a bending arm has absorbed part of the bend: the belief's variance grows by this factor times
    # the square of the bend over the noise.
    taken_along: float = 3.0
    # Hypotheses less probable than this without a change are left out: even with one they hardly count.
    least: float = 1e-6
    none = 1e-3  # 1-sigma that stands for an absent error
    # Runs of neighbours count by their means; a run's length is this share of its age, at most this many pairs.
    run_share, longest_run = 0.04, 6
    # Any of this many newest runs may be the onset of a change; older onsets are spaced by this share of their age. A
    # change is best seen soon after it, when a wrongly counted pair costs most.
    each, spacing = 30, 0.1
    # A pair far from the median of this many neighbours is clipped. Where more than half of them moved together, the
    # median moved as well.
    neighbours = 5
    max_pairs: int = 1200  # maximum number of pairs, the newest ones, that are evaluated


# Log evidence of other pairs about bends of each length, without any such pairs.
NO_EVIDENCE = (0.0,) * len(BendSettings.lengths)


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs of neighbours, represented by their means."""

    angles: FloatArray  # of all pairs (n, d) [rad, or for a prismatic joint the equivalent]
    starts: IntArray  # the first pair of each run (m,)
    # means of the derivatives by the known parameters, then by joints' own errors, and of errors, times the square root
    # of the run's length (m, 3, p)
    rows: FloatArray
    known: int  # number of the known parameters, with a prior of variance 1
    within: float  # sum of the squares of errors around their means
    fitted: bool  # True if the known parameters were fitted to these pairs, which then carry no information about them

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
        """Return runs of pairs with these starts.

        Args:
            angles: angles of all pairs (n, d).
            known: derivatives by the known parameters (n, 3, k).
            turning: derivatives by each joint, for a joint's own error of 1 (n, 3, d).
            errors: (n, 3).
            starts: the first pair of each run (m,).
            fitted: True if the known parameters were fitted to these pairs.
        """
        lengths = np.diff(np.append(starts, len(angles)))
        rows = np.concatenate([known, _own_errors(angles, turning), errors[..., None]], axis=2)
        means = np.add.reduceat(rows, starts) / lengths[:, None, None]
        within = float(np.square(errors - np.repeat(means[..., -1], lengths, axis=0)).sum())
        return cls(angles, starts, means * np.sqrt(lengths)[:, None, None], known.shape[2], within, fitted)

    @property
    def lengths(self) -> FloatArray:
        """Number of pairs of each run (m,)."""
        return np.diff(np.append(self.starts, len(self.angles))).astype(np.float64)

    @cached_property
    def axes(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Eigenvalues (m,) and eigenvectors (m, m) of the runs' covariance, for bends of each length and of size 1."""
        on_circles = np.concatenate([np.cos(self.angles), np.sin(self.angles)], axis=1)
        alike, lengths = on_circles @ on_circles.T - self.angles.shape[1], self.lengths
        found = list[tuple[FloatArray, FloatArray]]()
        for length in BendSettings.lengths:
            kernel = np.exp(alike / length**2)
            summed = np.add.reduceat(np.add.reduceat(kernel, self.starts, axis=0), self.starts, axis=1)
            values, axes = np.linalg.eigh(summed / np.sqrt(lengths * lengths[:, None]))
            found.append((np.maximum(values, 0.0), axes))
        return tuple(found)


@dataclass(frozen=True, eq=False)
class Bends:
    """Probable hypotheses of one bend length: sizes, joints' own errors and noises."""

    axes: FloatArray  # the coordinates of runs in which each bend is diagonal (m, m)
    weights: FloatArray  # inverse variance of each coordinate (h, m)
    known: FloatArray  # projection of rows of runs onto the known parameters and joints' own errors (h, k, 3 m)
    logs: FloatArray  # log probability of each (h,)

    def sums(self, rows: FloatArray) -> FloatArray:
        """Return weighted products (h, p, p) of rows (m, 3, p) of runs, minus the part of the known parameters."""
        turned = np.tensordot(self.axes.T, rows, axes=1)
        products = np.tensordot(self.weights, turned.transpose(0, 2, 1) @ turned, axes=1)
        common = self.known @ turned.reshape(-1, rows.shape[2])
        return products - common.transpose(0, 2, 1) @ common


def log_evidence(runs: Runs) -> list[FloatArray]:
    """Return the log evidence of bends in pairs without a change between them, for each length (h,).

    Hypotheses are in the same order for all runs: each joints' own error with each noise with each size.
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
        for turn in BendSettings.turns:
            prior = _prior(runs, k, turn)
            precision = sums[:, :known, :known] + prior[:, None] * np.eye(known)
            left = sums[:, known:, known:] - crossed.transpose(0, 2, 1) @ np.linalg.solve(precision, crossed)
            volume = np.linalg.slogdet(precision)[1] - np.log(prior).sum(axis=1)
            of_length.append(logs - 0.5 * (left[:, 0, 0] + volume))
        found.append(np.concatenate(of_length))
    return found


def probable_bends(runs: Runs, before: Sequence[FloatArray | float]) -> list[Bends]:
    """Return the hypotheses that are probable given these pairs without a change, and other pairs (`log_evidence`)."""
    evidence = zip(log_evidence(runs), before, strict=True)
    logs = [now + past + _log_prior(k) for k, (now, past) in enumerate(evidence)]
    total = np.logaddexp.reduce(np.concatenate(logs))
    return [
        _chosen(runs, k, each - total)
        for k, each in enumerate(logs)
        if (each - total > np.log(BendSettings.least)).any()
    ]


def _chosen(runs: Runs, k: int, logs: FloatArray) -> Bends:
    values, axes = runs.axes[k]
    probable = np.flatnonzero(logs > np.log(BendSettings.least))
    every = _weights(k, values)[0]
    weights = every[probable % len(every)]
    priors = np.concatenate([_prior(runs, k, turn) for turn in BendSettings.turns])
    turned = np.tensordot(axes.T, runs.rows[..., :-1], axes=1)
    known = np.empty((len(probable), turned.shape[2], turned.shape[0] * 3))
    for h, (prior, weight) in enumerate(zip(priors[probable], weights, strict=True)):
        weighed = (turned * weight[:, None, None]).reshape(-1, turned.shape[2])
        precision = weighed.T @ turned.reshape(weighed.shape) + np.diag(prior)
        known[h] = np.linalg.solve(cast(FloatArray, np.linalg.cholesky(precision)), weighed.T)
    return Bends(axes, weights, known, logs[probable])


def _log_prior(k: int) -> FloatArray:
    """Return the log prior of each hypothesis (h,) of the k-th length, not normalised."""
    sizes, turns = (
        np.tile(_sizes(k), len(BendSettings.turns) * len(BendSettings.noises)),
        np.repeat(BendSettings.turns, len(BendSettings.noises) * len(_sizes(k))),
    )
    # A bend of size zero has no length: it counts once for each length.
    shares = np.where(sizes == 0.0, float(len(BendSettings.lengths)), 1.0)
    return np.log(
        np.where(sizes + turns == 0.0, shares * (len(BendSettings.bends) * len(BendSettings.turns) - 1.0), shares)
    )


def _sizes(k: int) -> FloatArray:
    return np.array(BendSettings.bends if k == 0 else BendSettings.bends[1:])


def _weights(k: int, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return inverse variances of runs (h, m) for each noise with each size of a bend, and the noises squared (h,)."""
    noises = np.repeat(np.square(BendSettings.noises), len(_sizes(k)))
    sizes = np.tile(np.square(_sizes(k)), len(BendSettings.noises))
    return 1.0 / (noises[:, None] * (1.0 + sizes[:, None] * values)), noises


def _prior(runs: Runs, k: int, turn: float) -> FloatArray:
    """Return the prior precision (h, p) of the known parameters and joints' own errors, for each noise and bend."""
    squares = np.tile(np.square(_sizes(k)), len(BendSettings.noises)) + turn**2
    left_open = np.full(len(squares), BendSettings.open**2) if runs.fitted else 1.0 + BendSettings.taken_along * squares
    known = np.repeat(1.0 / left_open[:, None], runs.known, axis=1)
    own = np.full((len(known), runs.rows.shape[2] - 1 - runs.known), max(turn, BendSettings.none) ** -2.0)
    return np.concatenate([known, own], axis=1)


def _own_errors(angles: FloatArray, turning: FloatArray) -> FloatArray:
    """Return derivatives (n, 3, 2 d h) by the harmonics of each joint's own error, a Gaussian process of variance 1.

    Its kernel exp(−(1 − cos Δ) / ℓ²) has, for the harmonic n > 0, the share 2 exp(−1 / ℓ²) I_n(1 / ℓ²) with the Bessel
    function I_n.
    """
    columns: list[FloatArray] = []
    for wave in range(1, BendSettings.harmonics + 1):
        share = 2.0 * float(ive(wave, BendSettings.own_length**-2.0))
        for of_angle in (np.cos, np.sin):
            columns.append(np.sqrt(share) * of_angle(wave * angles)[:, None] * turning)
    return np.concatenate(columns, axis=2)


def log_ratios_if_bending(
    angles: FloatArray,
    errors: FloatArray,
    known: FloatArray,
    turning: FloatArray,
    changed: FloatArray,
    places: Sequence[slice],
    sizes: FloatArray,
    suspected: int,
    before: Sequence[FloatArray | float],
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the log likelihood ratio of each kind of change to none, for an arm that bends before and after.

    The errors of all pairs are the sum of these terms: the unknown part of the chain, a change from some pair on,
    noise, a smooth function of the joint values, and an error of each joint that is a smooth function of its own value.
    The smooth function is a Gaussian process with variance a² exp(−Σ_j (1 − cos Δ_j) / ℓ²) on each coordinate. Its a
    and ℓ and the noise are weighted by their probability given all pairs without a change.

    Args:
        angles: configurations (n, d) [rad, or for a prismatic joint the equivalent], at most `BendSettings.max_pairs`.
        errors: errors of a model not fitted to any of the pairs, in units of their noise (n, 3).
        known: their derivatives by the known parameters, whose prior is of variance 1 (n, 3, k).
        turning: their derivatives by each joint, scaled so that 1 moves the marker by about the noise (n, 3, d).
        changed: their derivatives by the parameters that may change (n, 3, c).
        places: the columns of `changed` of each kind of change.
        sizes: sizes of a change, 1-sigma of each number.
        suspected: the most probable onset if the arm is rigid.
        before: evidence of other pairs about bends, from `log_evidence_of_bends`.

    Returns:
        Onsets (t,), ascending, the number of pairs that each stands for, and the ratios (t, kinds).
    """
    pairs, errors = len(angles), _without_outliers(errors)
    ages = _ages(pairs, BendSettings.run_share, BendSettings.longest_run)
    starts = np.array(sorted({suspected, *(pairs - age for age in ages)}))
    runs = Runs.of(angles, known, turning, errors, starts, fitted=False)
    bends = probable_bends(runs, before)
    means = np.add.reduceat(changed, starts) / np.sqrt(runs.lengths)[:, None, None]
    changing = np.concatenate([means, runs.rows[..., -1:]], axis=2)
    firsts = _apart(starts, pairs, suspected)
    ratios = np.empty((len(firsts), len(places)))
    for k, first in enumerate(firsts):
        since = changing.copy()
        since[starts < first, :, :-1] = 0.0
        found = [_compared(each.sums(since), places, sizes) + each.logs[:, None] for each in bends]
        ratios[k] = np.logaddexp.reduce(np.concatenate(found), axis=0)
    return firsts, np.diff(np.append(firsts, pairs)).astype(np.float64), ratios


def log_evidence_of_bends(
    angles: FloatArray, errors: FloatArray, known: FloatArray, turning: FloatArray
) -> list[FloatArray]:
    """Return the evidence about bends in pairs to which the belief was fitted.

    Arguments as in `log_ratios_if_bending`.
    """
    starts = np.arange(0, len(angles), BendSettings.longest_run)
    return log_evidence(Runs.of(angles, known, turning, _without_outliers(errors), starts, fitted=True))


def _compared(sums: FloatArray, places: Sequence[slice], sizes: FloatArray) -> FloatArray:
    """Return the log ratios (h, kinds) of each kind of change to none.

    Args:
        sums: sums of products of the derivatives by changes, and of the errors (h, p, p).
        places: the columns of each kind of change.
        sizes: sizes of a change, 1-sigma of each number.
    """
    information, score = sums[:, :-1, :-1], sums[:, :-1, -1]
    return np.stack([log_ratios(information[:, at, at], score[:, at], sizes) for at in places], axis=1)


def _without_outliers(errors: FloatArray) -> FloatArray:
    """Return errors (n, 3) in units of their noise, clipped to lie near their neighbours."""
    if len(errors) < BendSettings.neighbours:
        return errors
    middles = np.median(np.lib.stride_tricks.sliding_window_view(errors, BendSettings.neighbours, axis=0), axis=2)
    ends = (BendSettings.neighbours // 2, BendSettings.neighbours // 2)
    middles = np.pad(middles, (ends, (0, 0)), mode="edge")
    off = errors - middles
    far = np.linalg.norm(off, axis=1, keepdims=True)
    return middles + off * np.minimum(1.0, RobustSettings.clipped_sigmas / np.maximum(far, 1e-300))


def _ages(pairs: int, share: float, longest: int) -> list[int]:
    """Return increasing ages, 1 to `pairs`, the last one included."""
    ages = [min(1, pairs)]
    while ages[-1] < pairs:
        ages.append(min(ages[-1] + max(1, min(int(share * ages[-1]), longest)), pairs))
    return ages


def _apart(starts: IntArray, pairs: int, suspected: int) -> IntArray:
    """Return starts (m,) that are far enough apart for their age, with the newest, the first and the suspected one."""
    kept = [int(starts[-1])]
    for start in starts[-2::-1].tolist():
        age, next_age = pairs - start, (1.0 + BendSettings.spacing) * (pairs - kept[-1])
        if age <= BendSettings.each or age >= next_age or start in (starts[0], suspected):
            kept.append(start)
    return np.array(kept[::-1])
