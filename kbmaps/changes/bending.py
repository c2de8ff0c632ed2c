"""What is left of a change if the arm may bend: what a smooth function of the joint values explains is none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.changes.mixture import log_ratios

# Over how far a bend is much the same [rad of all joints together], how large it is over the noise of a pair, and the
# noise over what it was thought to be: equally probable, each of them.
LENGTHS = (0.35, 0.7, 1.4)
BENDS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
NOISES = (0.5, 0.7, 1.0, 1.4)
# Runs of neighbours count by their means; a run is as long as this share of its distance from the change, at most so
# many pairs.
_RUN_SHARE, _LONGEST_RUN = 0.1, 8
# Of more pairs before it, and since, the nearest ones are looked at.
_MOST_PAIRS = 800


def log_ratios_if_it_bends(
    angles: FloatArray,
    errors: FloatArray,
    known: FloatArray,
    changed: FloatArray,
    places: Sequence[slice],
    first: int,
    sizes: FloatArray,
) -> FloatArray:
    """Log of the likelihood ratio of each kind of change to none, where the arm bends before and after (kinds,).

    The errors of all pairs are those of what was not known of the chain, a change from pair `first` on, noise, and a
    smooth function of the joint values: a Gaussian process with variance a² exp(−Σ_j (1 − cos Δ_j) / ℓ²). Its a and ℓ
    and the noise are as probable as all pairs make them without a change.

    Args:
        angles: where (n, d) [rad, or for a sliding joint what moves the marker as far].
        errors: of a model that knows none of the pairs, in units of their noise (n, 3).
        known: their derivatives by what is known, whose prior is of variance 1 (n, 3, k).
        changed: by what may change (n, 3, c).
        places: which of these each kind of change has.
        first: the first pair since the change.
        sizes: of a change, 1-sigma of each number.
    """
    nearest = slice(max(first - _MOST_PAIRS, 0), first + _MOST_PAIRS)
    first -= nearest.start
    angles, errors = angles[nearest], errors[nearest]
    since = (np.arange(len(angles)) >= first)[:, None, None]
    rows = np.concatenate([known[nearest], changed[nearest] * since, errors[..., None]], axis=2)
    starts = _run_starts(len(angles), first)
    lengths = np.diff(np.append(starts, len(angles))).astype(np.float64)
    means = np.add.reduceat(rows, starts) / lengths[:, None, None]
    within = float(np.square(errors - np.repeat(means[..., -1], lengths.astype(np.intp), axis=0)).sum())
    weighed = means * np.sqrt(lengths)[:, None, None]
    fits: list[FloatArray] = []
    evidence: list[FloatArray] = []
    for length in LENGTHS:
        kernel = _mean_kernel(angles, starts, lengths, length) * np.sqrt(lengths * lengths[:, None])
        values, vectors = np.linalg.eigh(kernel)
        turned = np.tensordot(vectors.T, weighed, axes=1)
        squares = turned.transpose(0, 2, 1) @ turned
        # A bend of no size has no length.
        bends = np.square(BENDS if length == LENGTHS[0] else BENDS[1:])
        noises = np.square(NOISES)
        spread = (noises[:, None, None] * (1.0 + bends[:, None] * np.maximum(values, 0.0))).reshape(-1, len(values))
        sums = np.tensordot(1.0 / spread, squares, axes=1)
        noise = np.repeat(noises, len(bends))
        rest = 1.5 * np.log(spread).sum(axis=1) + 1.5 * (len(angles) - len(starts)) * np.log(noise)
        fit, log_evidence = _compared(sums, known.shape[2], places, sizes)
        # What has no size stands for as many as there are lengths.
        share = np.tile(np.where(bends == 0.0, np.log(len(LENGTHS)), 0.0), len(noises))
        fits.append(fit)
        evidence.append(log_evidence - rest - 0.5 * within / noise + share)
    logs = np.concatenate(evidence)
    logs -= np.logaddexp.reduce(logs)
    return np.logaddexp.reduce(logs[:, None] + np.concatenate(fits), axis=0)


def _compared(
    sums: FloatArray, known: int, places: Sequence[slice], sizes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Log ratios (h, kinds) of each kind of change to none, and the log evidence (h,) of none.

    Args:
        sums: of products of the derivatives by what is known, by changes, and of the errors (h, p, p).
    """
    precision = sums[:, :known, :known] + np.eye(known)
    crossed = sums[:, :known, known:]
    rest = sums[:, known:, known:] - crossed.transpose(0, 2, 1) @ np.linalg.solve(precision, crossed)
    information, score = rest[:, :-1, :-1], rest[:, :-1, -1]
    evidence = -0.5 * rest[:, -1, -1] - 0.5 * np.linalg.slogdet(precision)[1]
    return np.stack([log_ratios(information[:, at, at], score[:, at], sizes) for at in places], axis=1), evidence


def _run_starts(pairs: int, first: int) -> IntArray:
    """First pairs of the runs, single ones where the change is and longer ones away from it."""
    return np.array(sorted({first - k for k in _steps(first)} | {first + k for k in _steps(pairs - first) if k < pairs - first}))


def _steps(end: int) -> list[int]:
    """0 and ever larger steps away, up to `end`."""
    steps = [0]
    while steps[-1] < end:
        steps.append(min(steps[-1] + max(1, min(int(_RUN_SHARE * steps[-1]), _LONGEST_RUN)), end))
    return steps


def _mean_kernel(angles: FloatArray, starts: IntArray, lengths: FloatArray, length: float) -> FloatArray:
    """Covariance (m, m) of the means of a bend of size 1 over runs of angles (n, d)."""
    on_circles = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
    kernel = np.exp((on_circles @ on_circles.T - angles.shape[1]) / length**2)
    summed = np.add.reduceat(np.add.reduceat(kernel, starts, axis=0), starts, axis=1)
    return summed / (lengths * lengths[:, None])
