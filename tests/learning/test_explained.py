from __future__ import annotations

import numpy as np
import pytest

from bodyschema.learning.changes.outlier_gate import is_explained


@pytest.mark.parametrize(
    ("before_mm", "after_mm", "expected_mm", "answer"),
    [
        (200.0, 6.0, 5.0, True),  # another tool
        (200.0, 60.0, 5.0, False),  # outliers that nothing explains
        (30.0, 8.0, 6.0, False),  # a poor model, of which any three numbers explain a part
    ],
)
def test_outlier_run_is_explained_by_small_remaining_error(
    before_mm: float, after_mm: float, expected_mm: float, answer: bool
) -> None:
    before, after = np.full(3, 1e-3 * before_mm), np.full(3, 1e-3 * after_mm)
    assert is_explained(before, after, 1e-3 * expected_mm) is answer
