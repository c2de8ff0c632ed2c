"""Write pairs to a store on a disk that may be full, slow or gone for a while."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from bodyschema.daemon.service.logs import RepeatSettings
from bodyschema.interfaces.errors import StoreUnwritable
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray, MarkerFix, Pair
from bodyschema.recordings.store.store import PairStore

log = logging.getLogger(__name__)

# A disk that takes longer per pair costs frames [s].
SLOW_S = 0.5

T = TypeVar("T")


class ResilientWriter:
    """Writer of pairs to a store. A pair that cannot be written is dropped, and the next one is tried."""

    def __init__(self, store: PairStore, wall: Clock) -> None:
        self._store, self._wall = store, wall
        self._problem: str | None = None
        self._dropped = 0
        self._last_slow: tuple[float, float] | None = None

    @property
    def complaints(self) -> list[str]:
        """Current problems with the disk, in sentences."""
        problems: list[str] = []
        if self._problem is not None:
            problems.append(
                f"{self._problem}. No samples are taken until the disk does ({self._dropped} frames so far)"
            )
        if self._last_slow is not None and self._wall.now() - self._last_slow[0] < RepeatSettings.repeated_s:
            problems.append(f"the disk of {self._store.file} is slow: a sample took {self._last_slow[1]:.1f} s")
        return problems

    def append(self, segment: int, q: FloatArray, fix: MarkerFix) -> Pair | None:
        """Return the committed pair; None if the disk did not accept it.

        Raises:
            StoreError: the store is damaged, or no longer a store.
        """
        pair = self.attempt(lambda: self._store.append(segment, self._wall.utc(), q, fix))
        if pair is not None and self._problem is not None:
            log.info("the disk takes samples again")
            self._problem, self._dropped = None, 0
        return pair

    def attempt(self, write: Callable[[], T]) -> T | None:
        """Return the result of `write`; None if the disk did not accept it.

        Raises:
            StoreError: as `append` does.
        """
        begun = self._wall.now()
        try:
            return write()
        except StoreUnwritable as error:
            if self._problem is None:
                log.error("%s; it is tried again with each sample", error)
            self._problem, self._dropped = str(error), self._dropped + 1
            return None
        finally:
            now = self._wall.now()
            if now - begun > SLOW_S:
                self._last_slow = now, now - begun
