"""What is left of a change if the arm may bend: what a smooth function of the joint values explains is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.changes.mixture import log_ratios

# Over how far a bend is much the same [rad of all joints together], how large it is over the noise of a pair, and the
# noise over what it was thought to be: equally probable, each of them.
LENGTHS = (0.7, 1.4)
BENDS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
NOISES = (0.5, 0.7, 1.0, 1.4)
# Those less probable than this by all pairs, were there no change, are left out: even with one they hardly count.
_LEAST = 1e-6
# Runs of neighbours count by their means; a run is as long as this share of its age, at most so many pairs.
_RUN_SHARE, _LONGEST_RUN = 0.04, 6
# A change may begin with each of so many runs, of older ones with those that lie so far apart, as a share of their age:
# it is best seen soon, where a pair that counts wrongly costs most.
_EACH, _SPACING = 30, 0.1
# A pair farther than so many sigmas from the middle of so many neighbours counts as that far: it may be an outlier.
# Where more than half of them moved together, the middle moved as well.
_CLIPPED_SIGMAS, _NEIGHBOURS = 4.0, 5
# So many of the newest pairs are looked at.
MOST_PAIRS = 1200


@dataclass(frozen=True, eq=False)
class _Bends:
    """Bends of one length and many sizes, with noises, in the coordinates in which each of them is diagonal.

    Attributes:
        axes: of these coordinates, runs by rows (m, m).
        weights: over the variance of each coordinate (h, m).
        logs: how probable each is (h,).
    """

    axes: FloatArray
    weights: FloatArray
    logs: FloatArray

    def sums(self, rows: FloatArray) -> FloatArray:
        """Of products of rows (m, 3, p) of runs, weighed (h, p, p)."""
        turned = np.tensordot(self.axes.T, rows, axes=1)
        return np.tensordot(self.weights, turned.transpose(0, 2, 1) @ turned, axes=1)


def log_ratios_if_it_bends(
    angles: FloatArray,
    errors: FloatArray,
    known: FloatArray,
    changed: FloatArray,
    places: Sequence[slice],
    sizes: FloatArray,
    suspected: int,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Log of the likelihood ratio of each kind of change to none, where the arm bends before and after.

    The errors of all pairs are those of what was not known of the chain, a change from some pair on, noise, and a
    smooth function of the joint values: a Gaussian process with variance a² exp(−Σ_j (1 − cos Δ_j) / ℓ²). Its a and ℓ
    and the noise are as probable as all pairs make them without a change.

    Args:
        angles: where (n, d) [rad, or for a sliding joint what moves the marker as far], n at most `MOST_PAIRS`.
        errors: of a model that knows none of the pairs, in units of their noise (n, 3).
        known: their derivatives by what is known, whose prior is of variance 1 (n, 3, k).
        changed: by what may change (n, 3, c).
        places: which of these each kind of change has.
        sizes: of a change, 1-sigma of each number.
        suspected: the pair with which it most probably began if the arm is rigid.

    Returns:
        Pairs (t,), ascending, with which the change may begin, for how many each stands, and the ratios (t, kinds).
    """
    pairs, errors = len(angles), _without_outliers(errors)
    starts = np.array(sorted({suspected, *(pairs - age for age in _ages(pairs, _RUN_SHARE, _LONGEST_RUN))}))
    lengths = np.diff(np.append(starts, pairs)).astype(np.float64)
    rows = np.concatenate([known, changed, errors[..., None]], axis=2)
    means = np.add.reduceat(rows, starts) / lengths[:, None, None]
    within = float(np.square(errors - np.repeat(means[..., -1], lengths.astype(np.intp), axis=0)).sum())
    weighed = means * np.sqrt(lengths)[:, None, None]
    unchanged = np.concatenate([weighed[..., : known.shape[2]], weighed[..., -1:]], axis=2)
    bends = _probable_bends(angles, starts, lengths, unchanged, within)
    firsts = _apart(starts, pairs, suspected)
    ratios = np.empty((len(firsts), len(places)))
    changing = slice(known.shape[2], known.shape[2] + changed.shape[2])
    for k, first in enumerate(firsts):
        since = weighed.copy()
        since[starts < first, :, changing] = 0.0
        found = [_compared(each.sums(since), known.shape[2], places, sizes) + each.logs[:, None] for each in bends]
        ratios[k] = np.logaddexp.reduce(np.concatenate(found), axis=0)
    return firsts, np.diff(np.append(firsts, pairs)).astype(np.float64), ratios


def _probable_bends(
    angles: FloatArray, starts: IntArray, lengths: FloatArray, rows: FloatArray, within: float
) -> list[_Bends]:
    """What bends and noises are probable by the means of runs, if nothing changed.

    Args:
        rows: derivatives by what is known, and errors, of runs (m, 3, k + 1), weighed.
        within: sum of the squares of errors around these means.
    """
    known, alone = rows.shape[2] - 1, 1.5 * (len(angles) - len(starts))
    found: list[_Bends] = []
    for length in LENGTHS:
        values, axes = np.linalg.eigh(_kernel(angles, starts, lengths, length))
        # A bend of no size has no length: it stands for as many as there are lengths.
        sizes = np.square(BENDS if length == LENGTHS[0] else BENDS[1:])
        noises = np.repeat(np.square(NOISES), len(sizes))
        share = np.tile(np.where(sizes == 0.0, np.log(len(LENGTHS)), 0.0), len(NOISES))
        spread = noises[:, None] * (1.0 + np.tile(sizes, len(NOISES))[:, None] * np.maximum(values, 0.0))
        bends = _Bends(axes, 1.0 / spread, np.empty(0))
        sums = bends.sums(rows)
        precision, crossed = sums[:, :known, :known] + np.eye(known), sums[:, :known, known:]
        left = sums[:, known:, known:] - crossed.transpose(0, 2, 1) @ np.linalg.solve(precision, crossed)
        logs = share - 0.5 * (left[:, 0, 0] + within / noises + np.linalg.slogdet(precision)[1])
        logs -= 1.5 * np.log(spread).sum(axis=1) + alone * np.log(noises)
        found.append(_Bends(axes, bends.weights, logs))
    total = np.logaddexp.reduce(np.concatenate([each.logs for each in found]))
    probable = [(each, each.logs - total > np.log(_LEAST)) for each in found]
    return [_Bends(each.axes, each.weights[kept], (each.logs - total)[kept]) for each, kept in probable if kept.any()]


def _compared(sums: FloatArray, known: int, places: Sequence[slice], sizes: FloatArray) -> FloatArray:
    """Log ratios (h, kinds) of each kind of change to none.

    Args:
        sums: of products of the derivatives by what is known, by changes, and of the errors (h, p, p).
    """
    precision, crossed = sums[:, :known, :known] + np.eye(known), sums[:, :known, known:]
    rest = sums[:, known:, known:] - crossed.transpose(0, 2, 1) @ np.linalg.solve(precision, crossed)
    information, score = rest[:, :-1, :-1], rest[:, :-1, -1]
    return np.stack([log_ratios(information[:, at, at], score[:, at], sizes) for at in places], axis=1)


def _without_outliers(errors: FloatArray) -> FloatArray:
    """Errors (n, 3) in units of their noise, in their order, none of them far from its neighbours."""
    if len(errors) < _NEIGHBOURS:
        return errors
    middles = np.median(np.lib.stride_tricks.sliding_window_view(errors, _NEIGHBOURS, axis=0), axis=2)
    ends = (_NEIGHBOURS // 2, _NEIGHBOURS // 2)
    middles = np.pad(middles, (ends, (0, 0)), mode="edge")
    off = errors - middles
    far = np.linalg.norm(off, axis=1, keepdims=True)
    return middles + off * np.minimum(1.0, _CLIPPED_SIGMAS / np.maximum(far, 1e-300))


def _ages(pairs: int, share: float, longest: int) -> list[int]:
    """Ever larger ages, 1 to `pairs`, the last one included."""
    ages = [min(1, pairs)]
    while ages[-1] < pairs:
        ages.append(min(ages[-1] + max(1, min(int(share * ages[-1]), longest)), pairs))
    return ages


def _apart(starts: IntArray, pairs: int, suspected: int) -> IntArray:
    """Those of the starts (m,) that are far enough apart for their age, with the newest, the first and this one."""
    kept = [int(starts[-1])]
    for start in starts[-2::-1].tolist():
        age = pairs - start
        if age <= _EACH or age >= (1.0 + _SPACING) * (pairs - kept[-1]) or start in (starts[0], suspected):
            kept.append(start)
    return np.array(kept[::-1])


def _kernel(angles: FloatArray, starts: IntArray, lengths: FloatArray, length: float) -> FloatArray:
    """Covariance (m, m) of the means of a bend of size 1 over runs of angles (n, d), weighed."""
    on_circles = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
    kernel = np.exp((on_circles @ on_circles.T - angles.shape[1]) / length**2)
    summed = np.add.reduceat(np.add.reduceat(kernel, starts, axis=0), starts, axis=1)
    return summed / np.sqrt(lengths * lengths[:, None])
