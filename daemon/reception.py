"""Queries that wait for their turn: how many, how large, how often, and whose turn it is.

Whoever asks much waits for himself: sources take turns, and each has its own limits. A query says its source where its
client gave `source_info`; those that say nothing count as one source.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from bodyschema.interfaces.errors import RequestError

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Limits:
    """What one source may ask under one key.

    Attributes:
        rate_hz: queries a second in the long run.
        burst: queries at once after a rest.
        waiting: queries without an answer yet.
        request_bytes: size of a request's payload.
        waiting_bytes: of their payloads; eight times that of all sources together.
        wait_s: a query that waited longer is refused, since nobody waits for its answer any more.
        sources: sources that wait at the same time.
    """

    rate_hz: float = 5000.0
    burst: int = 5000
    waiting: int = 100
    request_bytes: int = 4 * 2**20
    waiting_bytes: int = 8 * 2**20
    wait_s: float = 10.0
    sources: int = 100


LIMITS = Limits()
EVERYBODYS = 8  # times what one may let wait


@dataclass(slots=True)
class _Source(Generic[T]):
    """One who asks: his queries that wait, with the times they came at and their sizes, and what he may still ask."""

    left: float
    seen: float
    size: int = 0
    waiting: deque[tuple[float, int, T]] = field(default_factory=deque)


class Reception(Generic[T]):
    """The queries under one key until they are taken; many threads bring them, one takes them."""

    def __init__(self, limits: Limits = LIMITS, now: Callable[[], float] = time.monotonic) -> None:
        self._limits, self._now = limits, now
        self._lock = threading.Lock()
        self._size = 0
        # One for each query that waits, and one for the end: waking up by it is quicker than by a condition.
        self._turns: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._sources: OrderedDict[str, _Source[T]] = OrderedDict()  # in the order of their turns

    def admit(self, source: str, size: int, query: T) -> None:
        """Let a query wait.

        Args:
            size: of its payload [bytes].

        Raises:
            RequestError: it is too large, or its source asks too much; the message says how much is allowed.
        """
        limits = self._limits
        if size > limits.request_bytes:
            raise RequestError(f"the request has {size:,} bytes; send at most {limits.request_bytes:,}")
        with self._lock:
            asking = self._asking(source)
            if len(asking.waiting) >= limits.waiting:
                raise RequestError(
                    f"{limits.waiting} queries of {_named(source)} wait already, and that is the most; wait for an "
                    "answer before asking more"
                )
            if asking.size + size > limits.waiting_bytes:
                raise RequestError(
                    f"{asking.size:,} bytes of queries of {_named(source)} wait already, and {limits.waiting_bytes:,} "
                    "are the most; wait for an answer before asking more"
                )
            if self._size + size > EVERYBODYS * limits.waiting_bytes:
                raise RequestError(
                    f"{self._size:,} bytes of queries wait already, and {EVERYBODYS * limits.waiting_bytes:,} are the "
                    "most; ask again later"
                )
            if asking.left < 1.0:
                raise RequestError(
                    f"{_named(source)} asks too often; at most {limits.rate_hz:g} queries/s, {limits.burst} at once "
                    "after a rest"
                )
            asking.left -= 1.0
            asking.waiting.append((self._now(), size, query))
            asking.size += size
            self._size += size
        self._turns.put(None)

    def take(self) -> tuple[T, RequestError | None] | None:
        """The next query, as soon as there is one, and why it is not to be answered; None once closed."""
        self._turns.get()
        with self._lock:
            name = next((name for name, asking in self._sources.items() if asking.waiting), None)
            if name is None:
                return None
            asking = self._sources[name]
            came, size, query = asking.waiting.popleft()
            asking.size -= size
            self._size -= size
            self._sources.move_to_end(name)
        return query, self._too_late(came)

    def close(self) -> None:
        """Nothing is taken any more."""
        with self._lock:
            for asking in self._sources.values():
                asking.waiting.clear()
        self._turns.put(None)

    def _too_late(self, came: float) -> RequestError | None:
        waited = self._now() - came
        if waited <= self._limits.wait_s:
            return None
        return RequestError(f"the query waited {waited:.0f} s for its turn; at most {self._limits.wait_s:g} s")

    def _asking(self, source: str) -> _Source[T]:
        now, limits = self._now(), self._limits
        asking = self._sources.get(source)
        if asking is None:
            self._make_room()
            asking = self._sources[source] = _Source(float(limits.burst), now)
            self._sources.move_to_end(source, last=False)  # who comes first has his turn first
        asking.left = min(float(limits.burst), asking.left + limits.rate_hz * (now - asking.seen))
        asking.seen = now
        return asking

    def _make_room(self) -> None:
        if len(self._sources) < self._limits.sources:
            return
        resting = [name for name, asking in self._sources.items() if not asking.waiting]
        if not resting:
            raise RequestError(f"{self._limits.sources} clients wait already, and that is the most; ask again later")
        # Whoever rested longest has least to remember of.
        del self._sources[min(resting, key=lambda name: self._sources[name].seen)]


def _named(source: str) -> str:
    return f"the source {source}" if source else "clients that give no source_info"
