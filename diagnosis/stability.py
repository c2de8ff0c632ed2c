"""Whether a cause would be named again from other data of the same kind: blocks of time drawn anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .fit import Fit
from .held_out import Blocks
from .search import NAMED, nats

RESAMPLED = 50
# Of rivals that are as probable as that, none is the better one [nats].
_EQUAL = 1.0


@dataclass(frozen=True, eq=False)
class Instead:
    """What would be there in the place of a cause.

    Attributes:
        fit: with it, or with nothing.
        dof: how many more numbers it has than the cause.
        doubt: how much more it costs to have looked for it [nats].
    """

    fit: Fit
    dof: int
    doubt: float


def named_again(fit: Fit, nothing: Instead, rivals: Sequence[Instead], blocks: Blocks, seed: int) -> NDArray[np.bool_]:
    """In which of `RESAMPLED` draws of the blocks a cause of `fit` is worth naming, and more than each rival.

    No draw is fitted anew: the rows' likelihoods are drawn (Kishino, Miyata and Hasegawa 1990).
    """
    drawn = np.random.default_rng(seed).multinomial(blocks.count, np.full(blocks.count, 1.0 / blocks.count), RESAMPLED)
    again = _worths(fit, nothing, blocks, drawn) < -NAMED
    for rival in rivals:
        again &= _worths(fit, rival, blocks, drawn) < _EQUAL
    return again


def _worths(fit: Fit, instead: Instead, blocks: Blocks, drawn: NDArray[np.int64]) -> NDArray[np.float64]:
    """How much more probable something else is than the cause (draws,) [nats]."""
    gains = 2.0 * (drawn @ blocks.sums(instead.fit.row_log_likelihoods - fit.row_log_likelihoods))
    return np.array([nats(float(gain), instead.dof) for gain in gains]) - instead.doubt
