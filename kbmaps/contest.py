"""Which of several models predicts best, judged on pairs that none of them had learnt."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from kbmaps.autocorrelation import shared_by

# Pairs that two models have to have predicted both before they are compared.
FEWEST = 3
# The last pairs that are compared: so many, or this share of all so far where that is more, up to a bound.
SHORTEST, SHARE, LONGEST = 100, 0.5, 1000
# A model is worse than another when the difference of their squared errors is so many standard errors.
CLEARLY = 2.0
# A squared error counts up to so many times the median of the better model: an outlier tells of neither.
_CAP = 9.0


class Contest:
    """Squared distances between predictions and measurements, pair by pair, for the last pairs.

    Two models meet the same noise at the same pair, so their difference there tells more than their own errors do:
    prequential errors (Dawid 1984), compared in pairs.

    Args:
        rows: where to go on: by pair and model, the oldest first [m²].
        pairs: how many pairs there were so far, the rows included.
    """

    def __init__(self, rows: Iterable[Mapping[str, float]] = (), pairs: int = 0) -> None:
        self._rows: deque[dict[str, float]] = deque(map(dict, rows), maxlen=LONGEST)
        self._pairs = max(pairs, len(self._rows))

    @property
    def rows(self) -> list[dict[str, float]]:
        """By pair and model [m²]."""
        return [dict(row) for row in self._rows]

    @property
    def pairs(self) -> int:
        """How many pairs there were so far."""
        return self._pairs

    def add(self, squares: Mapping[str, float]) -> None:
        """One more pair: the squared distance [m²] of each model that predicted it. One that is not finite is none."""
        self._rows.append({name: square for name, square in squares.items() if math.isfinite(square)})
        self._pairs += 1
        while len(self._rows) > max(SHORTEST, SHARE * self._pairs):
            self._rows.popleft()

    def add_late(self, name: str, squares: Sequence[float], fresher: Sequence[str] = ()) -> None:
        """The squared distances [m²] of a model found only now for the last pairs, none of which it has learnt.

        They take the place of those of an older model by this name. The models `fresher` had learnt the pair just
        before each of these; what that gained them is no merit, and they are not compared there.
        """
        for row, square in zip(reversed(self._rows), reversed(squares), strict=False):
            for other in (name, *fresher):
                row.pop(other, None)
            if math.isfinite(square):
                row[name] = square

    def forget(self, name: str) -> None:
        """A model is another one from now on."""
        for row in self._rows:
            row.pop(name, None)

    def best(self, trusted: Sequence[str], present: str) -> str:
        """The model that shall answer: the most trusted one that is not clearly worse than any other.

        Args:
            trusted: the models, the most trusted first.
            present: who answers while too few pairs were predicted.
        """
        errors = {name: np.array([row.get(name, math.nan) for row in self._rows]) for name in trusted}
        tried = {name: values for name, values in errors.items() if np.isfinite(values).sum() >= FEWEST}
        for name, values in tried.items():
            if not any(_clearly_worse(values, other) for rival, other in tried.items() if rival != name):
                return name
        return present


def _clearly_worse(errors: np.ndarray, others: np.ndarray) -> bool:
    both = np.isfinite(errors) & np.isfinite(others)
    count = int(both.sum())
    if count < FEWEST:
        return False
    cap = _CAP * min(float(np.median(errors[both])), float(np.median(others[both])))
    losses = np.minimum(errors[both], cap) - np.minimum(others[both], cap)
    # A few losses are alike by chance: their spread is taken for no smaller than so few can tell.
    error = float(losses.std(ddof=1)) / math.sqrt(count) * (1.0 + 3.0 / count)
    # Neighbours on a path lose alike, and tell as much as one.
    error *= math.sqrt(shared_by((losses - losses.mean())[:, None]))
    return bool(losses.mean() > CLEARLY * error)
