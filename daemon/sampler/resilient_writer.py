"""Write pairs into the store despite a disk that is temporarily full, read-only, failing or slow."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from bodyschema.interfaces.errors import StoreUnwritable
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray, MarkerFix, Pair
from bodyschema.recordings.store.store import PairStore

log = logging.getLogger(__name__)

# A disk that takes longer per pair costs frames [s].
SLOW_S = 0.5
# How long a slow write stays in the complaints [s].
SLOW_TOLD_S = 60.0

T = TypeVar("T")


class ResilientWriter:
    """Appends pairs to a store. A pair that cannot be written is dropped, and the next one is tried."""

    def __init__(self, store: PairStore, wall: Clock) -> None:
        self._store, self._wall = store, wall
        self._refused: str | None = None
        self._lost = 0
        self._slow: tuple[float, float] | None = None

    @property
    def complaints(self) -> list[str]:
        """Current problems with the disk, in sentences."""
        said: list[str] = []
        if self._refused is not None:
            said.append(f"{self._refused}. No pairs are taken until the disk does ({self._lost} frames so far)")
        if self._slow is not None and self._wall.now() - self._slow[0] < SLOW_TOLD_S:
            said.append(f"the disk of {self._store.file} is slow: a pair took {self._slow[1]:.1f} s")
        return said

    def append(self, segment: int, q: FloatArray, fix: MarkerFix) -> Pair | None:
        """Return the committed pair; None if the disk did not accept it.

        Raises:
            StoreError: the store is damaged, or no longer a store.
        """
        pair = self.attempt(lambda: self._store.append(segment, self._wall.utc(), q, fix))
        if pair is not None and self._refused is not None:
            log.info("the disk takes pairs again, after %d frames that it did not", self._lost)
            self._refused, self._lost = None, 0
        return pair

    def attempt(self, write: Callable[[], T]) -> T | None:
        """Return the result of `write`; None if the disk did not accept it.

        Raises:
            StoreError: as for `append`.
        """
        begun = self._wall.now()
        try:
            return write()
        except StoreUnwritable as error:
            if self._refused is None:
                log.error("%s; it is tried again with each pair", error)
            self._refused, self._lost = str(error), self._lost + 1
            return None
        finally:
            now = self._wall.now()
            if now - begun > SLOW_S:
                self._slow = now, now - begun
