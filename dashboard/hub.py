"""Named documents of the page, and the browsers that follow them."""

from __future__ import annotations

import asyncio
import threading

import msgspec

from bodyschema.interfaces.errors import BodyschemaError

MOST_FOLLOWERS = 32


class HubFullError(BodyschemaError):
    """Too many browsers follow already."""


class Follower:
    """One browser: its pending documents, each in its newest version. A slow browser misses intermediate versions."""

    def __init__(self, documents: dict[str, bytes]) -> None:
        """Initialise for the running event loop; `documents` are the first to take."""
        self._loop, self._news = asyncio.get_running_loop(), asyncio.Event()
        self._lock = threading.Lock()
        self._pending = dict(documents)
        self._news.set()

    def offer(self, topic: str, document: bytes) -> None:
        """Queue a new document; from any thread."""
        with self._lock:
            self._pending[topic] = document
        self.wake()

    def wake(self) -> None:
        """Make `take` return; from any thread."""
        self._loop.call_soon_threadsafe(self._news.set)

    async def take(self, timeout_s: float) -> dict[str, bytes]:
        """Return new documents; empty after a timeout [s] without any."""
        try:
            await asyncio.wait_for(self._news.wait(), timeout_s)
        except TimeoutError:
            return {}
        self._news.clear()
        with self._lock:
            taken, self._pending = self._pending, {}
        return taken


class Hub:
    """Documents as JSON, each replaced as a whole, until it is `closed`; usable from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._documents: dict[str, bytes] = {}
        self._followers: set[Follower] = set()
        self.closed = False

    def put(self, topic: str, document: object) -> None:
        """Replace a document; followers get it if it differs."""
        encoded = msgspec.json.encode(document)
        with self._lock:
            if self._documents.get(topic) == encoded:
                return
            self._documents[topic] = encoded
            for follower in self._followers:
                follower.offer(topic, encoded)

    def all(self) -> bytes:
        """Return all documents as one JSON object."""
        with self._lock:
            return msgspec.json.encode({topic: msgspec.Raw(document) for topic, document in self._documents.items()})

    def follow(self) -> Follower:
        """Return a follower, to be passed to `unfollow` in the end; it starts with all documents.

        Raises:
            HubFullError: too many follow.
        """
        with self._lock:
            if len(self._followers) >= MOST_FOLLOWERS:
                raise HubFullError(f"{MOST_FOLLOWERS} pages are open already. Close one")
            follower = Follower(self._documents)
            self._followers.add(follower)
        return follower

    def unfollow(self, follower: Follower) -> None:
        with self._lock:
            self._followers.discard(follower)

    def close(self) -> None:
        """Close the hub: let every follower end."""
        with self._lock:
            self.closed = True
            for follower in self._followers:
                follower.wake()
