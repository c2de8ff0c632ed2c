"""Queue queries fairly, with limits on their number, size and rate.

Sources take turns, and each has its own limits, so that a source that asks much delays only itself. The source is the
client's `source_info`; all queries without one count as one source.
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
    """Limits of one source under one key."""

    rate_hz: float = 5000.0  # queries per second in the long run
    burst: int = 5000  # queries at once after a pause
    waiting: int = 100  # unanswered queries
    request_bytes: int = 4 * 2**20  # size of a request's payload
    waiting_bytes: int = 8 * 2**20  # total size of their payloads; all sources together may have eight times as much
    wait_s: float = 10.0  # a query that waited longer is refused, since its client no longer waits for the answer
    sources: int = 100  # number of sources waiting at the same time


LIMITS = Limits()
EVERYBODYS = 8  # total over all sources, as a multiple of one source's limit


@dataclass(slots=True)
class _Source(Generic[T]):
    """One source: its waiting queries with arrival times and sizes, and its remaining allowance."""

    left: float
    seen: float
    size: int = 0
    waiting: deque[tuple[float, int, T]] = field(default_factory=deque)


class QueryLimiter(Generic[T]):
    """The queries under one key until they are taken; many threads add them, one takes them."""

    def __init__(self, limits: Limits = LIMITS, now: Callable[[], float] = time.monotonic) -> None:
        self._limits, self._now = limits, now
        self._lock = threading.Lock()
        self._size = 0
        # One item for each waiting query, and one to end: a queue wakes its reader faster than a condition variable.
        self._turns: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._sources: OrderedDict[str, _Source[T]] = OrderedDict()  # in the order of their turns

    def admit(self, source: str, size: int, query: T) -> None:
        """Queue a query.

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
        """Return the next query, waiting for one, and the reason to refuse it, if any; None once closed."""
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
        waited, most = self._now() - came, self._limits.wait_s
        if waited <= most:
            return query, None
        return query, RequestError(f"the query waited {waited:.0f} s for its turn; at most {most:g} s")

    def close(self) -> None:
        """Stop taking queries."""
        with self._lock:
            for asking in self._sources.values():
                asking.waiting.clear()
        self._turns.put(None)

    def _asking(self, source: str) -> _Source[T]:
        now, limits = self._now(), self._limits
        asking = self._sources.get(source)
        if asking is None:
            self._make_room()
            asking = self._sources[source] = _Source(float(limits.burst), now)
            self._sources.move_to_end(source, last=False)  # first come, first served
        asking.left = min(float(limits.burst), asking.left + limits.rate_hz * (now - asking.seen))
        asking.seen = now
        return asking

    def _make_room(self) -> None:
        if len(self._sources) < self._limits.sources:
            return
        resting = [name for name, asking in self._sources.items() if not asking.waiting]
        if not resting:
            raise RequestError(f"{self._limits.sources} clients wait already, and that is the most; ask again later")
        # The source that rested longest loses the least state.
        del self._sources[min(resting, key=lambda name: self._sources[name].seen)]


def _named(source: str) -> str:
    return f"the source {source}" if source else "clients that give no source_info"
