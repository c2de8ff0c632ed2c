"""Whether a cause would be named again from other data of the same kind: blocks of time drawn anew."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from interfaces.records import FloatArray

from .fit import Fit
from .held_out import Blocks
from .scan import Candidate
from .search import NAMED, Search, nats

RESAMPLED = 50
# Of rivals that are as probable as that, none is the better one [nats].
_EQUAL = 1.0


def named_again(
    without: Fit, cause: Candidate, rivals: Sequence[Candidate], search: Search, blocks: Blocks, seed: int
) -> NDArray[np.bool_]:
    """In which of `RESAMPLED` draws of the blocks a cause is worth naming, more than each rival, to first order."""
    drawn = np.random.default_rng(seed).multinomial(blocks.count, np.full(blocks.count, 1.0 / blocks.count), RESAMPLED)
    own = _worths(without, cause, search, blocks, drawn)
    again = own > NAMED
    for rival in rivals:
        again &= own > _worths(without, rival, search, blocks, drawn) - _EQUAL
    return again


def _worths(fit: Fit, candidate: Candidate, search: Search, blocks: Blocks, drawn: NDArray[np.int64]) -> FloatArray:
    effect = candidate.effect
    basis = fit.orthogonal
    columns = fit.weighted(fit.run.columns(effect)[:, :, effect.amounts])
    columns = columns - basis @ np.einsum("nir,nik->rk", basis, columns)
    columns = columns / np.maximum(np.sqrt(np.square(columns).sum(axis=(0, 1))), 1e-300)
    inner = drawn @ blocks.sums(np.einsum("nia,nib->nab", columns, columns)).reshape(blocks.count, -1)
    gradient = drawn @ blocks.sums(np.einsum("nia,ni->na", columns, fit.left))
    squares = drawn @ blocks.sums(np.square(fit.left).sum(axis=1))
    rows = drawn @ blocks.sums(fit.noise.weights)
    k = columns.shape[2]
    amounts = np.linalg.solve(inner.reshape(-1, k, k) + 1e-9 * np.eye(k), gradient[:, :, None])[:, :, 0]
    shares = np.einsum("ma,ma->m", amounts, gradient) / np.maximum(squares, 1e-300)
    gains = -3.0 * rows * np.log1p(-np.clip(shares, 0.0, 0.999999))
    return np.array([nats(float(gain), candidate.dof) for gain in gains]) - search.doubt(candidate)
