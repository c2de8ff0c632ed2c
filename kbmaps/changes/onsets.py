"""Sums over the pairs since each candidate onset of a change."""

from __future__ import annotations

import numpy as np

from kbmaps.arrays import FloatArray, IntArray

# Each of the newest pairs may be the first of a change; older onsets are thinned to this share of their age.
SPACING = 0.15
_SLOTS = 96


class Onsets:
    """Sums over all pairs, and their values before each onset that is kept.

    Args:
        known: number of known parameters, with an uncertainty.
        changes: number of parameters that may change.
    """

    def __init__(self, known: int, changes: int) -> None:
        self._crossed, self._information = np.zeros((known, changes)), np.zeros((changes, changes))
        self._score = np.zeros(changes)
        self._crossed_before = np.zeros((_SLOTS, known, changes))
        self._information_before = np.zeros((_SLOTS, changes, changes))
        self._score_before = np.zeros((_SLOTS, changes))
        self._onset = np.zeros(_SLOTS, dtype=np.intp)
        self._slots: list[int] = []
        self._free = list(range(_SLOTS))
        self.pairs = 0

    @property
    def weights(self) -> FloatArray:
        """Number of pairs that each onset stands for (m,): itself and those after it that are no longer kept."""
        onsets = self._onset[self._slots]
        return np.diff(np.append(onsets, self.pairs)).astype(np.float64)

    def add(self, crossed: FloatArray, information: FloatArray, score: FloatArray) -> None:
        """Add a pair: D'C (k, c), C'C (c, c) and C'r (c,) of its derivatives D, C and its error r."""
        slot = self._free.pop()
        self._onset[slot] = self.pairs
        self._crossed_before[slot], self._information_before[slot] = self._crossed, self._information
        self._score_before[slot] = self._score
        self._slots.append(slot)
        self._crossed += crossed
        self._information += information
        self._score += score
        self.pairs += 1
        self._thin()

    def since(self) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """Return onsets (m,), ascending, and the sums from each of them on: (m, k, c), (m, c, c) and (m, c)."""
        slots = self._slots
        return (
            self._onset[slots],
            self._crossed - self._crossed_before[slots],
            self._information - self._information_before[slots],
            self._score - self._score_before[slots],
        )

    def _thin(self) -> None:
        """Drop the newest onset, except the first, whose neighbours are near enough to each other for their age."""
        for k in range(len(self._slots) - 2, 0, -1):
            before, after = self._onset[self._slots[k - 1]], self._onset[self._slots[k + 1]]
            if after - before <= SPACING * (self.pairs - after):
                self._free.append(self._slots.pop(k))
                return
        if not self._free:
            self._free.append(self._slots.pop(1))
