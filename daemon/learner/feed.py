"""Feed pairs to the learner, each once and in order: published pairs, and missed ones from the sampler's history."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

import msgspec

from bodyschema.daemon.sampler.history import Page, Unreadable
from bodyschema.daemon.transport.wire import PairMessage, decode, pair_from_wire
from bodyschema.interfaces.errors import BusError, RequestError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.waits import Waits
from bodyschema.learning.online_learner import OnlineLearner

log = logging.getLogger(__name__)


class FeedSettings:
    max_waiting: int = 1024  # pairs that the learner has not taken
    # Health reports a learner that is this many pairs behind: more than arrive in two or three seconds.
    behind: int = 100


History = Callable[[int], Page]


class _Stamp(msgspec.Struct, frozen=True):
    """The fields of a published pair that reveal the newest stored one."""

    store: str
    seq: int
    utc: str


@dataclass(frozen=True)
class _Stored:
    """The newest pair that is known to be stored, and when the learner received that information [s]."""

    seq: int
    utc: str
    received_at: float


class PairFeed:
    """Feed of an `OnlineLearner`. `offer` and `wake` may be called from any thread, `step` from one only.

    Attributes:
        problem: reason why arriving pairs are not learnt, or None.
        refused: reason why the last refused pair was refused, or None.
        foreign: identity of the store that pairs arrive from although the learner learnt from another one, or None.
        paused: True if pairs are left to history.
    """

    def __init__(
        self, learning: OnlineLearner, history: History, clock: Clock, beat: Callable[[], None] = lambda: None
    ) -> None:
        """Continue after the last pair that `learning` has.

        Args:
            history: returns stored pairs from a sequence number on, as many as fit into a reply; raises BusError
                without an answer.
            beat: called for each learnt pair, and after each history request.
        """
        self.lock = threading.Lock()
        self._learning, self._history, self._clock, self._beat = learning, history, clock, beat
        self._joints = learning.nominal.joints
        self._waiting: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        # Set by any thread: an item was not queued. All other attributes belong to `step`.
        self._missed = True
        self._behind, self.paused = False, False
        self._retry_at = 0.0
        self.refused: str | None = None
        self._published: tuple[bytes, float] | None = None
        self._newest: _Stored | None = None
        self.restart()

    @property
    def behind(self) -> int:
        """Number of pairs known to be stored and not learnt yet."""
        newest = self._newest_stored()
        return 0 if newest is None else max(newest.seq - self._cursor, 0)

    def age_s(self, utc: str | None) -> float | None:
        """Return the age [s] of a model whose newest pair was stored at `utc`, relative to the newest stored pair.

        The age is the time from this pair to the newest one known to be stored, by the sampler's clock, plus the time
        since the learner heard of the latter, by its own clock. None before any pair.
        """
        newest = self._newest_stored()
        if utc is None or newest is None:
            return None
        return self._clock.now() - newest.received_at + _seconds(utc, newest.utc)

    def offer(self, payload: bytes) -> None:
        """Accept a published pair."""
        self._published = payload, self._clock.now()
        if self._waiting.qsize() < FeedSettings.max_waiting:
            self._waiting.put(payload)
        else:
            self._missed = True

    def wake(self) -> None:
        """Note that the sampler is (back) online: check for missed pairs."""
        self._missed = True
        self._waiting.put(None)

    def pause(self) -> None:
        """Leave pairs to history until `resume`."""
        self.paused = True

    def resume(self) -> None:
        """Accept pairs again, starting with the missed ones."""
        self.paused = False
        self.wake()

    def restart(self) -> None:
        """Continue after the last pair that the learner has; call this after they have changed, holding `lock`."""
        counters = self._learning.counters
        self._store, self._cursor = counters.store, counters.last_seq
        self._published = self._newest = None
        self.problem: str | None = None
        self.foreign: str | None = None

    def step(self, timeout_s: float) -> None:
        """Process the offered pairs, or wait for one; catch up if some are missing."""
        try:
            payload = self._waiting.get(timeout=timeout_s)
        except queue.Empty:
            payload = None
        if self.paused:
            self._missed = True
            return
        if self._missed:
            self._missed, self._behind, self._retry_at = False, True, 0.0
        if payload is not None:
            self._receive(payload)
        if self._behind and self._clock.now() >= self._retry_at:
            self._catch_up()

    def _receive(self, payload: bytes) -> None:
        try:
            message = decode(payload, PairMessage)
        except RequestError as error:
            self._refuse(error)
            return
        with self.lock:
            if self._store is None:
                self._behind = True
            elif message.store != self._store:
                self._note_foreign_store(message.store)
                self._learning.refuse()
            elif message.seq == self._cursor + 1 and self._learn(message):
                self._cursor = message.seq
            elif message.seq > self._cursor:
                self._behind = True

    def _catch_up(self) -> None:
        """Request all pairs after the last one, page by page."""
        while not self.paused:
            self._beat()
            begin = self._cursor + 1
            try:
                reply = self._history(begin)
            except (BusError, RequestError) as error:
                log.debug("history could not be asked: %s", error)
                if isinstance(error, RequestError):
                    self.problem = f"the sampler does not give the samples from {begin} on: {error}"
                self._retry_at = self._clock.now() + Waits.retry_s
                return
            self._note_stored(reply)
            with self.lock:
                if begin == self._cursor + 1 and self._learn_page(reply):
                    return

    def _learn_page(self, reply: Page) -> bool:
        """Learn a page of history; return True if there is nothing more to request."""
        if self._store not in (None, reply.store):
            self._note_foreign_store(reply.store)
            self._behind = False
            return True
        if reply.last_seq < self._cursor:
            self.problem = (
                f"the sampler's store ends at sample {reply.last_seq}, but {self._cursor} were learnt: it is an older "
                "copy. Put the newer one back, or send the command reset_to_prior"
            )
            self.foreign, self._behind = reply.store, False
            return True
        self.problem = self.foreign = None
        new = [message for message in reply.pairs if message.seq > self._cursor]
        for message in new:
            self._beat()
            self._skip_missing(message.seq - self._cursor - 1)
            self._learn(message)
            self._store, self._cursor = reply.store, message.seq
        self._learning.recovered(len(new))
        self._behind = self._cursor < reply.last_seq and bool(new)
        return not self._behind

    def _newest_stored(self) -> _Stored | None:
        """Return the newest stored pair that is known; the last publication is decoded only when this is called."""
        published, newest = self._published, self._newest
        if published is None:
            return newest
        payload, received_at = published
        try:
            stamp = decode(payload, _Stamp)
        except RequestError:
            return newest
        if self._store not in (None, stamp.store) or (newest is not None and stamp.seq < newest.seq):
            return newest
        return _Stored(stamp.seq, stamp.utc, received_at)

    def _note_stored(self, reply: Page) -> None:
        """Note the newest stored pair of a page of history; request it if the store extends beyond the page."""
        known = self._newest_stored()
        if self._store not in (None, reply.store) or (known is not None and known.seq >= reply.last_seq):
            return
        pairs = reply.pairs
        if not pairs or pairs[-1].seq < reply.last_seq:
            try:
                pairs = self._history(reply.last_seq).pairs
            except (BusError, RequestError) as error:
                log.debug("the newest sample could not be asked for: %s", error)
        utc = pairs[-1].utc if pairs and isinstance(pairs[-1], PairMessage) else ""
        self._newest = _Stored(reply.last_seq, utc, self._clock.now())

    def _skip_missing(self, missing: int) -> None:
        """Continue after pairs that the sampler no longer has; it numbers without gaps, so they existed before."""
        if missing > 0:
            log.warning(
                "the sampler has no samples %d to %d any more: they were deleted ([daemon] keep_days, keep_mb) or its "
                "disk changed them (see its health); learning continues with the next",
                self._cursor + 1,
                self._cursor + missing,
            )
            self._learning.missed(missing)

    def _learn(self, message: PairMessage | Unreadable) -> bool:
        try:
            if isinstance(message, Unreadable):
                raise RequestError(message.why)
            self._learning.learn(pair_from_wire(message, self._joints), self._clock.now())
        except RequestError as error:
            self._refuse(error)
            return False
        return True

    def _refuse(self, error: RequestError) -> None:
        log.warning("a sample was refused: %s", error)
        self.refused = str(error)
        self._learning.refuse()

    def _note_foreign_store(self, store: str) -> None:
        self.foreign = store
        self.problem = (
            f"samples now come from the store {store}, but this learner learnt from {self._store}; they are not mixed. "
            "Send the command reset_to_prior to start again with the new store, or restore the old store"
        )


def _seconds(begin: str, end: str) -> float:
    """Return the time from `begin` to `end`, in ISO 8601 [s]; 0 if it is negative or one of them is invalid."""
    try:
        return max((datetime.fromisoformat(end) - datetime.fromisoformat(begin)).total_seconds(), 0.0)
    except (ValueError, TypeError):
        return 0.0
