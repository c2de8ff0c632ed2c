from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.calibration.evaluate import BLOCKS, ErrorFigures, EvaluationError, coverage, split_blocks


def runs(mask: np.ndarray) -> int:
    return int(np.count_nonzero(np.diff(mask.astype(int), prepend=0) == 1))


@given(st.integers(BLOCKS, 3000), st.floats(0.01, 0.99))
def test_held_out_rows_are_blocks_of_similar_length(rows: int, share: float) -> None:
    split = split_blocks(rows, share)
    block = rows / BLOCKS
    assert abs(split.held_out.sum() - split.blocks * block) < BLOCKS
    assert abs(split.blocks - share * BLOCKS) <= 1.0
    assert 0 < split.held_out.sum() < rows


def test_three_of_ten_blocks_lie_apart() -> None:
    split = split_blocks(1000, 0.3)
    assert runs(split.held_out) == 3
    assert split.held_out.sum() == 300


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1, float("nan")])
def test_a_share_that_leaves_nothing_is_refused(share: float) -> None:
    with pytest.raises(EvaluationError, match="between 0 and 1"):
        split_blocks(100, share)


def test_too_few_rows_are_refused() -> None:
    with pytest.raises(EvaluationError, match="too few"):
        split_blocks(BLOCKS - 1, 0.3)


def test_figures_are_those_of_the_distances() -> None:
    predicted = np.array([[0, 0, 3.0], [0, 4.0, 0], [0, 0, 0]])
    figures = ErrorFigures.of(predicted, np.zeros((3, 3)))
    assert (figures.pairs, figures.median_m, figures.max_m) == (3, 3.0, 4.0)
    assert figures.mean_m == pytest.approx(7 / 3)
    assert figures.rms_m == pytest.approx(np.sqrt(25 / 3))


def test_an_honest_claim_covers_two_thirds() -> None:
    rng = np.random.default_rng(5)
    truth = rng.normal(size=(4000, 3))
    predicted, measured = truth + rng.normal(size=truth.shape) * 3, truth + rng.normal(size=truth.shape) * 4
    assert coverage(predicted, measured, np.full(truth.shape, 3.0), 4.0) == pytest.approx(0.683, abs=0.02)
    assert coverage(predicted, measured, np.full(truth.shape, 3.0)) < 0.5
