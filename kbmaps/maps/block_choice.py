"""Choice of the prior's weight by cross-validation over blocks of pairs.

Neighbouring pairs of a guided arm share their errors (timestamps, shading of the marker, backlash). The evidence
assumes independent noise, and so mistakes shared errors for shape. A block of pairs that was held out as a whole
shares none of its errors with the others.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import FloatArray, matching_rows, rows
from kbmaps.maps.kbmap import KBMap
from kbmaps.maps.stack import BasisStack


class BlockSettings:
    max_blocks: int = 20
    first_precision: float = 1e-3  # precision used while there are too few pairs for blocks
    # Neighbours on a path are nearly the same configuration: they share this much of their prior variance. In bases
    # over the whole turn that is a step of 8 degrees, along which a function that bends three times as fast still
    # shares 0.95.
    path_correlation: float = 0.995
    smallest_eigenvalue: float = 1e-15  # Relative to the largest eigenvalue of the kernel: smaller ones are rounding
    min_blocks: int = 4
    block_pairs: int = 30  # along a guided path, pairs this far apart share little of their errors
    # Candidate precisions, relative to the kernel's mean diagonal: from almost no prior to hardly any learning.
    precisions = 10.0 ** np.arange(-13.0, 3.25, 0.5)


def follow_a_path(prior: KBMap, q: ArrayLike) -> bool:
    """Return True if consecutive configurations q (n, d) [rad, m] are neighbours on a path."""
    left, right = BasisStack(prior.bases).halves(rows("q", q, len(prior.bases)))
    square = (left * left).sum(axis=1) * (right * right).sum(axis=1)
    inner = (left[:-1] * left[1:]).sum(axis=1) * (right[:-1] * right[1:]).sum(axis=1)
    correlations = inner / np.sqrt(square[:-1] * square[1:])
    return bool(len(inner)) and bool(np.median(correlations) > BlockSettings.path_correlation)


def blockwise_precision(prior: KBMap, q: ArrayLike, x: ArrayLike) -> float:
    """Return the precision λ of the prior for `ExactLearner.solve` with the best predictions of held-out blocks.

    The pairs are cut into runs of neighbours, and those of each run, at most `block_pairs`, are predicted from all
    other runs. Of the precisions that do this equally well, to one standard error, the largest is taken: the data do
    not require a more flexible map (Breiman et al., Classification and Regression Trees, 1984, section 3.4.3).

    Args:
        prior: the prior, in the bases of the learner.
        q, x: pairs in the order of recording, (n, d) [rad, m] and (n, 3) [m].

    Returns:
        λ as in `ExactLearner.solve`; with too few pairs for `BlockSettings.min_blocks`, one that trusts the prior.
    """
    angles, positions = matching_rows(q, x, len(prior.bases))
    count = min(len(angles) // BlockSettings.block_pairs, BlockSettings.max_blocks)
    if count < BlockSettings.min_blocks:
        return (
            BlockSettings.first_precision * float(np.diag(_kernel(prior, angles)).mean())
            if len(angles)
            else BlockSettings.first_precision
        )
    runs = [run[: BlockSettings.block_pairs] for run in np.array_split(np.arange(len(angles)), count)]
    chosen = np.concatenate(runs)
    kernel = _kernel(prior, angles[chosen])
    errors = positions[chosen] - prior.predict(angles[chosen])
    precisions = BlockSettings.precisions * float(np.diag(kernel).mean())
    left_out = _left_out_errors(kernel, errors, count, precisions)
    means = left_out.mean(axis=1)
    best = int(means.argmin())
    spread = float(left_out[best].std(ddof=1)) / math.sqrt(count)
    return float(precisions[np.flatnonzero(means <= means[best] + spread)[-1]])


def _kernel(prior: KBMap, q: FloatArray) -> FloatArray:
    """Return the inner products of the weight vectors: a product over the joints (n, n)."""
    left, right = BasisStack(prior.bases).halves(q)
    return (left @ left.T) * (right @ right.T)


def _left_out_errors(kernel: FloatArray, errors: FloatArray, blocks: int, precisions: FloatArray) -> FloatArray:
    """Return the mean distance between held-out positions and their predictions from all other blocks [m]: (λ, block).

    With C = K + λI, the errors of block B predicted from the others are ([C⁻¹]_BB)⁻¹ (C⁻¹ e)_B: Rasmussen and Williams,
    Gaussian Processes for Machine Learning, 2006, eq. (5.12), for blocks. One eigendecomposition of K serves all λ.
    """
    variances, directions = np.linalg.eigh(kernel)
    parts = directions.reshape(blocks, -1, len(kernel))
    components = directions.T @ errors
    means = np.full((len(precisions), blocks), math.inf)
    for row, precision in enumerate(precisions):
        if variances[0] + precision <= BlockSettings.smallest_eigenvalue * variances[-1]:
            continue
        inverses = 1.0 / (variances + precision)
        multipliers = parts @ (inverses[:, None] * components)
        corners = (parts * inverses) @ parts.transpose(0, 2, 1)
        left_out = cast(FloatArray, np.linalg.solve(corners, multipliers))
        means[row] = np.linalg.norm(left_out, axis=2).mean(axis=1)
    return means
