"""Families of numbers that follow a few common functions are found at low rank."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodyschema.diagnosis.unnamed.low_rank import low_rank, numbers_of
from bodyschema.interfaces.records import FloatArray

MOVES, AMOUNTS = 6, 7
RANKS = st.integers(1, MOVES)
SEEDS = st.integers(0, 2**31)


def columns(rng: np.random.Generator) -> FloatArray:
    drawn = rng.normal(size=(400, MOVES * AMOUNTS))
    return drawn / np.linalg.norm(drawn, axis=0)


def explained(columns: FloatArray, wanted: FloatArray, rank: int) -> tuple[float, FloatArray]:
    return low_rank(columns.T @ columns, columns.T @ wanted, AMOUNTS, rank)


@given(SEEDS)
def test_one_function_signal_is_explained_at_rank_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    has, moves, function = columns(rng), rng.normal(size=MOVES), rng.normal(size=AMOUNTS)
    wanted = 100.0 * has @ np.outer(moves, function).ravel()
    share, found = explained(has, wanted, 1)
    assert share == pytest.approx(wanted @ wanted, rel=1e-3)
    assert abs(found[:, 0] @ function) == pytest.approx(np.linalg.norm(function), rel=1e-3)


@given(SEEDS, RANKS)
def test_a_part_explains_no_more_than_the_whole(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    has, wanted = columns(rng), rng.normal(size=400)
    whole = wanted @ has @ np.linalg.solve(has.T @ has, has.T @ wanted)
    assert explained(has, wanted, rank)[0] <= whole * (1.0 + 1e-6)


@given(RANKS)
def test_parameter_count_rises_with_rank_up_to_all(rank: int) -> None:
    assert numbers_of(MOVES, AMOUNTS, rank) <= MOVES * AMOUNTS
    assert numbers_of(MOVES, AMOUNTS, MOVES) == MOVES * AMOUNTS
    assert rank == 1 or numbers_of(MOVES, AMOUNTS, rank) > numbers_of(MOVES, AMOUNTS, rank - 1)
