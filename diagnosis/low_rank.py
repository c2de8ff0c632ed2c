"""Tables of numbers of low rank: where a few moves follow a few functions, however many of both there are."""

from __future__ import annotations

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .fit import solved

# Rounds in which moves and functions are found in turn, until what they explain rises by less than this.
_ROUNDS, _ENOUGH = 12, 0.1
# Beside sums of squares of columns as long as one.
_RIDGE = 1e-7


def numbers_of(moves: int, amounts: int, rank: int) -> int:
    """How many numbers are free in a table of so many rows and columns and this rank."""
    return rank * (moves + amounts - rank)


def low_rank(inner: FloatArray, toward: FloatArray, amounts: int, rank: int) -> tuple[float, FloatArray]:
    """The table of numbers (a, b) of a rank that explains most, by alternating least squares.

    Args:
        inner: products (a b, a b) of the columns, one for each of a moves and b amounts.
        toward: their products (a b,) with what is to be explained.
        amounts: b.

    Returns:
        The sum of squares that it explains, and the functions (b, rank) that the moves follow.
    """
    moves = len(toward) // amounts
    inner = inner + _RIDGE * np.eye(len(toward))
    table, square = toward.reshape(moves, amounts), inner.reshape(moves, amounts, moves, amounts)
    start = solved(inner, toward).reshape(moves, amounts)
    functions = np.linalg.svd(start, full_matrices=False)[2][:rank].T
    explained = 0.0
    for _ in range(_ROUNDS):
        follow = np.einsum("ibjc,br,cs->irjs", square, functions, functions).reshape(moves * rank, -1)
        ways = solved(follow, (table @ functions).ravel()).reshape(moves, rank)
        lead = np.einsum("ibjc,ir,js->brcs", square, ways, ways).reshape(amounts * rank, -1)
        wanted = (table.T @ ways).ravel()
        found = solved(lead, wanted)
        functions = np.linalg.qr(found.reshape(amounts, rank))[0]
        before, explained = explained, float(wanted @ found)
        if explained - before < _ENOUGH:
            break
    return explained, functions
