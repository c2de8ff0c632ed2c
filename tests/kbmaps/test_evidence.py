"""The search for the scale of maximum evidence."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kbmaps.maps.evidence import most_evident

LOW, HIGH = 1e-9, 1e9


def peaked(at: float, asked: list[float]) -> Callable[[float], float]:
    """Return a parabola in the logarithm of the scale, which records each scale it is asked for."""

    def log_evidence(scale: float) -> float:
        asked.append(scale)
        return -((math.log(scale) - math.log(at)) ** 2)

    return log_evidence


@given(at=st.floats(1e-6, 1e6), start=st.floats(1e-6, 1e6))
def test_evidence_peak_is_found_within_tenth_of_step(at, start):
    found = most_evident(peaked(at, []), start, LOW, HIGH)
    assert abs(math.log(found / at)) <= 0.1 * math.log(8.0) + 1e-9


@pytest.mark.parametrize("off", [1.0, 1.2, 1 / 1.2])
def test_search_started_at_peak_takes_three_evaluations(off):
    asked: list[float] = []
    found = most_evident(peaked(0.3, asked), 0.3 * off, LOW, HIGH)
    assert len(asked) == 3
    assert asked[-1] == found


def test_peak_beyond_the_limits_gives_the_limit():
    assert most_evident(peaked(1e12, []), 1.0, LOW, HIGH) == pytest.approx(HIGH)


def test_level_evidence_keeps_the_start():
    assert most_evident(lambda _: 0.0, 0.7, LOW, HIGH) == pytest.approx(0.7)
