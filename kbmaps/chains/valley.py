"""Deviation of chain parameters whose posterior is curved."""

from __future__ import annotations

import numpy as np

from kbmaps.arrays import FloatArray
from kbmaps.chains.belief import ChainBelief, squared
from kbmaps.pairs import Pairs

# A direction is open if at least this share of the prior's variance remains.
_OPEN = 0.5
# No step along a direction changes a parameter by more than this [rad, m]: beyond, the second order does not hold.
_LONGEST_STEP = 0.1


def deviations(belief: ChainBelief, pairs: Pairs, sigma: FloatArray) -> FloatArray:
    """Return the RMS deviation (size,) [rad, m] of each parameter's true value from the mean, to second order.

    Changes that the pairs cannot separate lie along a curve, not along its tangent. An example is another offset of the
    last joint, compensated for by the marker: it takes the marker round the joint's axis. With y standard normal along
    the open directions W_o, the closed ones W_c follow, so that the pairs stay as well explained (our derivation):

        θ = m + W_o y + W_c (z + ½ Σ B_kl y_k y_l)    B_kl = −(J W_c)⁺ ∂²x(W_o e_k, W_o e_l)

    Half the square form has the mean tr B / 2 and the variance tr B² / 2.

    Args:
        belief: after the pairs.
        pairs: the n pairs, or some that stand for them.
        sigma: 1-sigma (n,) of a coordinate there [m].
    """
    q = pairs.q
    opened, closed, follow = _sides(belief, pairs, sigma)
    bend = np.empty((len(belief.mean), opened.shape[1], opened.shape[1]))
    for k, direction in enumerate(opened.T):
        step = _LONGEST_STEP / max(float(np.abs(direction).max()), _LONGEST_STEP)
        _, ahead = belief.parameters.linearised(belief.mean + step * direction, q)
        _, behind = belief.parameters.linearised(belief.mean - step * direction, q)
        second = pairs.whitened((ahead - behind) @ opened) / (2.0 * step * sigma[:, None, None])
        bend[:, k] = -closed @ (follow @ second.reshape(-1, opened.shape[1]))
    mean = 0.5 * np.einsum("ikk->i", bend)
    variance = np.square(belief.root).sum(axis=1) + 0.5 * np.square(bend).sum(axis=(1, 2))
    return np.sqrt(variance + np.square(mean))


def _sides(belief: ChainBelief, pairs: Pairs, sigma: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a root W of the belief in an open part (size, k) and a closed part W_c (size, c), and (J W_c)⁺ (c, 3 n).

    In units of the posterior, the eigenvalues of (J W)ᵀ J W are the shares of the prior's variance that were removed.
    """
    free, triangle = squared(belief.root)
    root = np.zeros((len(belief.mean), len(free)))
    root[free] = triangle
    _, jacobian = belief.parameters.linearised(belief.mean, pairs.q)
    rows = (pairs.whitened(jacobian[:, :, free] @ triangle) / sigma[:, None, None]).reshape(-1, len(free))
    taken, vectors = np.linalg.eigh(rows.T @ rows)
    opened, closed = vectors[:, taken <= 1.0 - _OPEN], vectors[:, taken > 1.0 - _OPEN]
    follow = (rows @ closed / taken[taken > 1.0 - _OPEN]).T
    return root @ opened, root @ closed, follow
