"""What is left of a change if the arm may bend: what a smooth function of the joint values explains is none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kbmaps.arrays import FloatArray, IntArray
from kbmaps.changes.bends import Runs, log_evidence, probable_bends
from kbmaps.changes.mixture import log_ratios

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
    """Log of the likelihood ratio of each kind of change to none, where the arm bends before and after.

    The errors of all pairs are those of what was not known of the chain, a change from some pair on, noise, a smooth
    function of the joint values, which is a Gaussian process with variance a² exp(−Σ_j (1 − cos Δ_j) / ℓ²) on each
    coordinate, and an error of each joint that is a smooth function of its own value. Their a and ℓ and the noise are
    as probable as all pairs make them without a change.

    Args:
        angles: where (n, d) [rad, or for a sliding joint what moves the marker as far], n at most `MOST_PAIRS`.
        errors: of a model that knows none of the pairs, in units of their noise (n, 3).
        known: their derivatives by what is known, whose prior is of variance 1 (n, 3, k).
        turning: by each joint, such that 1 moves the marker by about the noise (n, 3, d).
        changed: by what may change (n, 3, c).
        places: which of these each kind of change has.
        sizes: of a change, 1-sigma of each number.
        suspected: the pair with which it most probably began if the arm is rigid.
        before: what other pairs say of bends, as `log_evidence_of_bends`.

    Returns:
        Pairs (t,), ascending, with which the change may begin, for how many each stands, and the ratios (t, kinds).
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
    """What pairs to which the belief was fitted say of bends; arguments as of `log_ratios_if_it_bends`."""
    starts = np.arange(0, len(angles), _LONGEST_RUN)
    return log_evidence(Runs.of(angles, known, turning, _without_outliers(errors), starts, fitted=True))


def _compared(sums: FloatArray, places: Sequence[slice], sizes: FloatArray) -> FloatArray:
    """Log ratios (h, kinds) of each kind of change to none.

    Args:
        sums: of products of the derivatives by changes, and of the errors (h, p, p).
    """
    information, score = sums[:, :-1, :-1], sums[:, :-1, -1]
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
