"""Fit low-rank tables of numbers: a few functions drive all motions, for any number of both."""

from __future__ import annotations

import numpy as np

from bodyschema.diagnosis.fit.fit import solved
from bodyschema.interfaces.records import FloatArray


class _Settings:
    rounds, enough = 12, 0.1  # maximum of alternating rounds; stop when the explained sum rises by less
    ridge = 1e-7  # ridge, relative to columns of unit length


def numbers_of(moves: int, amounts: int, rank: int) -> int:
    """Return the number of free parameters of a table with this size and rank."""
    return rank * (moves + amounts - rank)


def low_rank(inner: FloatArray, rhs: FloatArray, amounts: int, rank: int) -> tuple[float, FloatArray]:
    """Fit the table of numbers (a, b) of a given rank that explains most, by alternating least squares.

    Args:
        inner: products (a b, a b) of the columns, one for each of a moves and b amounts.
        rhs: their products (a b,) with the data to be explained.
        amounts: b.

    Returns:
        The sum of squares that it explains, and the functions (b, rank) that the motions follow.
    """
    moves = len(rhs) // amounts
    inner = inner + _Settings.ridge * np.eye(len(rhs))
    table, square = rhs.reshape(moves, amounts), inner.reshape(moves, amounts, moves, amounts)
    start = solved(inner, rhs).reshape(moves, amounts)
    functions = np.linalg.svd(start, full_matrices=False)[2][:rank].T
    explained = 0.0
    for _ in range(_Settings.rounds):
        follow = np.einsum("ibjc,br,cs->irjs", square, functions, functions).reshape(moves * rank, -1)
        motions = solved(follow, (table @ functions).ravel()).reshape(moves, rank)
        lead = np.einsum("ibjc,ir,js->brcs", square, motions, motions).reshape(amounts * rank, -1)
        wanted = (table.T @ motions).ravel()
        found = solved(lead, wanted)
        functions = np.linalg.qr(found.reshape(amounts, rank))[0]
        before, explained = explained, float(wanted @ found)
        if explained - before < _Settings.enough:
            break
    return explained, functions
