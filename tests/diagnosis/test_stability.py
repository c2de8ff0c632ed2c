"""Probabilities allow for evidence that only a few blocks of time hold."""

from __future__ import annotations

import numpy as np
import pytest

from bodyschema.diagnosis.assess.rivals import bagged
from bodyschema.diagnosis.search.held_out import Blocks

ROWS, LEAD = 200, 6.0


def probability(lead: np.ndarray) -> float:
    """Return the probability of a fit that leads a rival by (n,) [nats]."""
    return float(bagged([-float(lead.sum())], [-lead], Blocks.cut(ROWS, 20), seed=0)[0])


def test_evidence_of_all_blocks_counts_in_full() -> None:
    assert probability(np.full(ROWS, LEAD / ROWS)) == pytest.approx(1.0 / (1.0 + np.exp(-LEAD)), abs=1e-3)


def test_evidence_of_one_block_is_not_sure() -> None:
    assert 0.5 < probability(np.where(np.arange(ROWS) < 10, LEAD / 10, 0.0)) < 0.9
