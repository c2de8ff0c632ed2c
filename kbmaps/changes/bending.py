"""Evidence for a change if the arm may bend: a smooth function of the joint values is not a change."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.changes.bends import Runs, log_evidence, probable_bends
from kbmaps.changes.kinds import log_ratios
from kbmaps.robust import CLIPPED_SIGMAS

# Runs of neighbours count by their means; a run's length is this share of its age, at most this many pairs.
_RUN_SHARE, _LONGEST_RUN = 0.04, 6
# Any of this many newest runs may be the onset of a change; older onsets are spaced by this share of their age. A
# change is best seen soon after it, when a wrongly counted pair costs most.
_EACH, _SPACING = 30, 0.1
# A pair far from the median of this many neighbours is clipped. Where more than half of them moved together, the
# median moved as well.
_NEIGHBOURS = 5
# Maximum number of pairs, the newest ones, that are evaluated.
MOST_PAIRS = 1200


def log_ratios_if_it_bends(
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
        angles: configurations (n, d) [rad, or for a prismatic joint the equivalent], n at most `MOST_PAIRS`.
        errors: of a model that knows none of the pairs, in units of their noise (n, 3).
        known: their derivatives by the known parameters, whose prior is of variance 1 (n, 3, k).
        turning: by each joint, such that 1 moves the marker by about the noise (n, 3, d).
        changed: by the parameters that may change (n, 3, c).
        places: the columns of `changed` of each kind of change.
        sizes: of a change, 1-sigma of each number.
        suspected: the most probable onset if the arm is rigid.
        before: evidence of other pairs about bends, from `log_evidence_of_bends`.

    Returns:
        Onsets (t,), ascending, the number of pairs that each stands for, and the ratios (t, kinds).
    """
    pairs, errors = len(angles), _without_outliers(errors)
    starts = np.array(sorted({suspected, *(pairs - age for age in _ages(pairs, _RUN_SHARE, _LONGEST_RUN))}))
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

    Arguments as in `log_ratios_if_it_bends`.
    """
    starts = np.arange(0, len(angles), _LONGEST_RUN)
    return log_evidence(Runs.of(angles, known, turning, _without_outliers(errors), starts, fitted=True))


def _compared(sums: FloatArray, places: Sequence[slice], sizes: FloatArray) -> FloatArray:
    """Return the log ratios (h, kinds) of each kind of change to none.

    Args:
        sums: of products of the derivatives by changes, and of the errors (h, p, p).
        places: the columns of each kind of change.
        sizes: of a change, 1-sigma of each number.
    """
    information, score = sums[:, :-1, :-1], sums[:, :-1, -1]
    return np.stack([log_ratios(information[:, at, at], score[:, at], sizes) for at in places], axis=1)


def _without_outliers(errors: FloatArray) -> FloatArray:
    """Return errors (n, 3) in units of their noise, clipped to lie near their neighbours."""
    if len(errors) < _NEIGHBOURS:
        return errors
    middles = np.median(np.lib.stride_tricks.sliding_window_view(errors, _NEIGHBOURS, axis=0), axis=2)
    ends = (_NEIGHBOURS // 2, _NEIGHBOURS // 2)
    middles = np.pad(middles, (ends, (0, 0)), mode="edge")
    off = errors - middles
    far = np.linalg.norm(off, axis=1, keepdims=True)
    return middles + off * np.minimum(1.0, CLIPPED_SIGMAS / np.maximum(far, 1e-300))


def _ages(pairs: int, share: float, longest: int) -> list[int]:
    """Return ever larger ages, 1 to `pairs`, the last one included."""
    ages = [min(1, pairs)]
    while ages[-1] < pairs:
        ages.append(min(ages[-1] + max(1, min(int(share * ages[-1]), longest)), pairs))
    return ages


def _apart(starts: IntArray, pairs: int, suspected: int) -> IntArray:
    """Return starts (m,) that are far enough apart for their age, with the newest, the first and the suspected one."""
    kept = [int(starts[-1])]
    for start in starts[-2::-1].tolist():
        age = pairs - start
        if age <= _EACH or age >= (1.0 + _SPACING) * (pairs - kept[-1]) or start in (starts[0], suspected):
            kept.append(start)
    return np.array(kept[::-1])
