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
TOTAL_RATIO = 8  # total over all sources, as a multiple of one source's limit


@dataclass(slots=True)
class _Source(Generic[T]):
    """One source: its waiting queries with arrival times and sizes, and its remaining allowance."""

    allowance: float
    last_seen: float
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
            state = self._source(source)
            if len(state.waiting) >= limits.waiting:
                raise RequestError(
                    f"{limits.waiting} queries of {_label(source)} wait already, and that is the most; wait for an "
                    "answer before asking more"
                )
            if state.size + size > limits.waiting_bytes:
                raise RequestError(
                    f"{state.size:,} bytes of queries of {_label(source)} wait already, and {limits.waiting_bytes:,} "
                    "are the most; wait for an answer before asking more"
                )
            if self._size + size > TOTAL_RATIO * limits.waiting_bytes:
                raise RequestError(
                    f"{self._size:,} bytes of queries wait already, and {TOTAL_RATIO * limits.waiting_bytes:,} are the "
                    "most; ask again later"
                )
            if state.allowance < 1.0:
                raise RequestError(
                    f"{_label(source)} asks too often; at most {limits.rate_hz:g} queries/s, {limits.burst} at once "
                    "after a rest"
                )
            state.allowance -= 1.0
            state.waiting.append((self._now(), size, query))
            state.size += size
            self._size += size
        self._turns.put(None)

    def take(self) -> tuple[T, RequestError | None] | None:
        """Return the next query, waiting for one, and the reason to refuse it, if any; None once closed."""
        self._turns.get()
        with self._lock:
            name = next((name for name, state in self._sources.items() if state.waiting), None)
            if name is None:
                return None
            state = self._sources[name]
            arrived_at, size, query = state.waiting.popleft()
            state.size -= size
            self._size -= size
            self._sources.move_to_end(name)
        waited, limit = self._now() - arrived_at, self._limits.wait_s
        if waited <= limit:
            return query, None
        return query, RequestError(f"the query waited {waited:.0f} s for its turn; at most {limit:g} s")

    def close(self) -> None:
        """Stop taking queries."""
        with self._lock:
            for state in self._sources.values():
                state.waiting.clear()
        self._turns.put(None)

    def _source(self, source: str) -> _Source[T]:
        now, limits = self._now(), self._limits
        state = self._sources.get(source)
        if state is None:
            self._make_room()
            state = self._sources[source] = _Source(float(limits.burst), now)
            self._sources.move_to_end(source, last=False)  # first come, first served
        state.allowance = min(float(limits.burst), state.allowance + limits.rate_hz * (now - state.last_seen))
        state.last_seen = now
        return state

    def _make_room(self) -> None:
        if len(self._sources) < self._limits.sources:
            return
        idle = [name for name, state in self._sources.items() if not state.waiting]
        if not idle:
            raise RequestError(f"{self._limits.sources} clients wait already, and that is the most; ask again later")
        # The source that rested longest loses the least state.
        del self._sources[min(idle, key=lambda name: self._sources[name].last_seen)]


def _label(source: str) -> str:
    return f"the source {source}" if source else "clients that give no source_info"
