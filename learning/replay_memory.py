"""Memory of the pairs for replay, and the order of replay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

IntArray = NDArray[np.intp]

RUN = 20  # number of neighbours that are sampled together


class PairMemory:
    """Newest `capacity` pairs, in arrays. `count` is the number of all pairs since the last `clear`, kept or not."""

    def __init__(self, joints: int, capacity: int) -> None:
        self._q = np.empty((capacity, joints))
        self._x = np.empty((capacity, 3))
        self._cov = np.full((capacity, 3, 3), np.nan)
        self._turns = np.full((capacity, 4), np.nan)
        self.count = self._first = 0

    @property
    def complete(self) -> bool:
        """True if all of them are kept."""
        return self._oldest == 0

    def __len__(self) -> int:
        return self.count - self._oldest

    def append(
        self, q: FloatArray, x: FloatArray, cov: FloatArray | None = None, turns: FloatArray | None = None
    ) -> None:
        """Keep pairs, q (n, d) and x (n, 3); drop the oldest to make room.

        Args:
            cov: their covariances (n, 3, 3) [m²], NaN for a pair without one; None if none has any.
            turns: their orientations, quaternions (n, 4), likewise.
        """
        places = np.arange(self.count, self.count + len(q)) % len(self._q)
        self._q[places], self._x[places] = q, x
        self._cov[places] = np.nan if cov is None else cov
        self._turns[places] = np.nan if turns is None else turns
        self.count += len(q)

    def clear(self) -> None:
        self.count = self._first = 0

    def place_of(self, count: int) -> int:
        """Return the number of kept pairs older than the one numbered `count` (from 0)."""
        return min(max(count - self._oldest, 0), len(self))

    def restore(
        self, q: FloatArray, x: FloatArray, count: int, cov: FloatArray | None = None, turns: FloatArray | None = None
    ) -> None:
        self.count = self._first = count - len(q)
        self.append(q, x, cov, turns)

    def since(self, count: int, limit: int | None = None) -> tuple[FloatArray, FloatArray, int]:
        """Return the kept pairs from number `count` (from 0) on: q (n, d), x (n, 3), and the count after them."""
        places = self._places_since(count, limit)
        return self._q[places], self._x[places], max(count, self._oldest) + len(places)

    def cov_since(self, count: int, limit: int | None = None) -> FloatArray:
        """Return covariances (n, 3, 3) [m²] of the pairs of `since`: NaN for a pair without one."""
        return self._cov[self._places_since(count, limit)]

    def turns_since(self, count: int, limit: int | None = None) -> FloatArray:
        """Return orientations (n, 4) of the pairs of `since`: quaternions x, y, z, w, NaN for a pair without one."""
        return self._turns[self._places_since(count, limit)]

    def _places_since(self, count: int, limit: int | None) -> IntArray:
        begin = max(count, self._oldest)
        return np.arange(begin, self.count if limit is None else min(self.count, begin + limit)) % len(self._q)

    def all(self) -> tuple[FloatArray, FloatArray]:
        """Return all kept pairs in order: q (n, d), x (n, 3)."""
        q, x, _ = self.since(0)
        return q, x

    def spread_before(self, end: int, limit: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return at most `limit` of the kept pairs before the one numbered `end`, in order, as in `append`.

        They are evenly spread runs of `RUN` neighbours, which show the errors that neighbours on a path share.
        """
        kept = max(end - self._oldest, 0)
        begins = np.linspace(self._oldest, end - RUN, max(limit // RUN, 1)).astype(np.intp)
        runs = (begins[:, None] + np.arange(min(RUN, limit))).ravel()
        numbers = np.arange(self._oldest, end) if kept <= limit else runs
        return *self._by_number(numbers), self._cov[numbers % len(self._q)]

    def at(self, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the kept pairs at places 0 (the oldest) ... len − 1: q (n, d), x (n, 3)."""
        return self._by_number(self._oldest + places)

    @property
    def _oldest(self) -> int:
        return max(self._first, self.count - len(self._q))

    def _by_number(self, numbers: IntArray) -> tuple[FloatArray, FloatArray]:
        places = numbers % len(self._q)
        return self._q[places], self._x[places]


class Permutations:
    """Order of replay: in each epoch every place once, in a random order determined by seed and epoch."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._epoch = self._places = self._taken = 0
        self._order: IntArray = np.empty(0, dtype=np.intp)

    @property
    def position(self) -> tuple[int, int, int]:
        """State for `restore`: epochs begun, the places of the current one, and the number of them taken."""
        return self._epoch, self._places, self._taken

    def take(self, count: int, places: int) -> IntArray:
        """Return up to `count` of the places 0 ... places − 1; fewer at the end of an epoch."""
        if self._taken == self._places:
            self._begin(self._epoch + 1, places)
        taken = self._order[self._taken : self._taken + count]
        self._taken += len(taken)
        return taken

    def restart(self) -> None:
        """Drop the rest of the epoch: the places have changed their meaning."""
        self._taken = self._places

    def restore(self, position: tuple[int, int, int]) -> None:
        epoch, places, taken = position
        self._begin(epoch, places)
        self._taken = taken

    def _begin(self, epoch: int, places: int) -> None:
        self._epoch, self._places, self._taken = epoch, places, 0
        self._order = np.random.default_rng([self._seed, epoch]).permutation(places)
