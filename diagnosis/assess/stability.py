"""Test by block resampling how reliably a cause is named again, and how probable it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.worth import NAMED, nats
from bodyschema.diagnosis.search.held_out import Blocks
from bodyschema.interfaces.records import FloatArray

RESAMPLED = 50
# Number of resamplings for probabilities; 0.3 to 3 times this changes them by less than 0.03.
_BAGGED = 400
# Rivals within this margin count as equally probable [nats].
_EQUAL = 1.0


@dataclass(frozen=True, eq=False)
class Instead:
    """A fit with an alternative in the place of a cause.

    Attributes:
        fit: with the alternative, or with nothing.
        dof: number of its parameters less those of the cause.
        doubt: its multiplicity penalty less that of the cause [nats].
    """

    fit: Fit
    dof: int
    doubt: float


def bagged(behind: Sequence[float], rows: Sequence[FloatArray], blocks: Blocks, seed: int) -> FloatArray:
    """Return the probability of a cause and of each alternative to it (1 + m,), as the mean over block resamplings.

    No model is exact, so evidence that a few blocks decide is not sure (Huggins and Miller 2023, bagged posteriors).

    Args:
        behind: log-evidence of each alternative over the cause [nats].
        rows: the part of it that each row holds (n,).
    """
    drawn = _drawn(blocks, _BAGGED, seed) - 1
    nats = np.array([np.zeros(_BAGGED), *(b + drawn @ blocks.sums(own) for b, own in zip(behind, rows, strict=True))])
    odds = np.exp(nats - nats.max(axis=0))
    return np.asarray((odds / odds.sum(axis=0)).mean(axis=1), dtype=np.float64)


def named_again(fit: Fit, nothing: Instead, rivals: Sequence[Instead], blocks: Blocks, seed: int) -> NDArray[np.bool_]:
    """Return True for each of `RESAMPLED` block resamplings in which a cause is worth naming and beats each rival.

    The rows' likelihoods are resampled, without refitting (Kishino, Miyata and Hasegawa 1990).
    """
    drawn = _drawn(blocks, RESAMPLED, seed)
    again = _worths(fit, nothing, blocks, drawn) < -NAMED
    for rival in rivals:
        again &= _worths(fit, rival, blocks, drawn) < _EQUAL
    return again


def _drawn(blocks: Blocks, times: int, seed: int) -> NDArray[np.int64]:
    """Return how often each block is drawn (times, blocks)."""
    return np.random.default_rng(seed).multinomial(blocks.count, np.full(blocks.count, 1.0 / blocks.count), times)


def _worths(fit: Fit, instead: Instead, blocks: Blocks, drawn: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the evidence gain of an alternative over the cause (draws,) [nats]."""
    gains = 2.0 * (drawn @ blocks.sums(instead.fit.row_log_likelihoods - fit.row_log_likelihoods))
    # Larger tolerances can stand for a cause row by row; what they cost does not depend on the rows drawn.
    gains += 2.0 * (fit.prior_cost - instead.fit.prior_cost)
    return np.array([nats(float(gain), instead.dof) for gain in gains]) - instead.doubt
