"""The learner's pairs, each once and in order: what is published, and from the sampler's history what was missed."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable

from daemon.history import Page, Unreadable
from daemon.learning import Learning
from daemon.wire import PairMessage, decode, pair_from_wire
from interfaces.errors import BusError, RequestError
from interfaces.protocols import Clock

log = logging.getLogger(__name__)

WAITING = 1024
RETRY_S = 1.0

History = Callable[[int], Page]


class PairFeed:
    """Feeds a `Learning`. `offer` and `wake` may be called from any thread, `step` from one.

    A pair is published after the sampler has stored it, so whatever does not follow the last pair directly (a gap, a
    restart, a full queue) is simply asked for: history is the one way to recover.

    Attributes:
        lock: held while pairs are being learnt; whoever resets the learner takes it.
    """

    def __init__(
        self, learning: Learning, history: History, clock: Clock, beat: Callable[[], None] = lambda: None
    ) -> None:
        """Go on after the pairs that `learning` has.

        Args:
            history: stored pairs from a sequence number on, as many as fit into a reply; BusError when nobody answers.
            beat: is called with each pair that was learnt, and each time that history was asked.
        """
        self.lock = threading.Lock()
        self._learning, self._history, self._clock, self._beat = learning, history, clock, beat
        self._joints = learning.nominal.joints
        self._waiting: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        # Set by any thread: something was not put into the queue. The rest is `step`'s own.
        self._missed = True
        self._behind, self._paused = False, False
        self._retry_at = 0.0
        self._refused: str | None = None
        self.restart()

    @property
    def problem(self) -> str | None:
        """Why pairs that come are not learnt, or None."""
        return self._problem

    @property
    def refused(self) -> str | None:
        """What was wrong with the pair that was refused last, or None."""
        return self._refused

    @property
    def paused(self) -> bool:
        """Whether pairs are left to history for now."""
        return self._paused

    def offer(self, payload: bytes) -> None:
        """A published pair."""
        if self._waiting.qsize() < WAITING:
            self._waiting.put(payload)
        else:
            self._missed = True

    def wake(self) -> None:
        """The sampler has come (back): see what was missed."""
        self._missed = True
        self._waiting.put(None)

    def pause(self) -> None:
        """Leave pairs to history until `resume`."""
        self._paused = True

    def resume(self) -> None:
        """Take pairs again, those missed first."""
        self._paused = False
        self.wake()

    def restart(self) -> None:
        """Go on after the pairs that the learner has; call it when they have changed, holding `lock`."""
        counters = self._learning.counters
        self._store, self._cursor = counters.store, counters.last_seq
        self._problem: str | None = None
        self._foreign: str | None = None

    @property
    def foreign_store(self) -> str | None:
        """The store that pairs come from although the learner learnt from another one; None when all is well."""
        return self._foreign

    def step(self, timeout_s: float) -> None:
        """Take what has been offered, or wait for it; catch up when something is missing."""
        try:
            payload = self._waiting.get(timeout=timeout_s)
        except queue.Empty:
            payload = None
        if self._paused:
            self._missed = True
            return
        if self._missed:
            self._missed, self._behind, self._retry_at = False, True, 0.0
        if payload is not None:
            self._take(payload)
        if self._behind and self._clock.now() >= self._retry_at:
            self._catch_up()

    def _take(self, payload: bytes) -> None:
        try:
            message = decode(payload, PairMessage)
        except RequestError as error:
            self._refuse(error)
            return
        with self.lock:
            if self._store is None:
                self._behind = True
            elif message.store != self._store:
                self._meet_foreign(message.store)
                self._learning.refuse()
            elif message.seq == self._cursor + 1 and self._learnt(message):
                self._cursor = message.seq
            elif message.seq > self._cursor:
                self._behind = True

    def _catch_up(self) -> None:
        """Ask for all pairs after the last one, page by page."""
        while not self._paused:
            self._beat()
            begin = self._cursor + 1
            try:
                reply = self._history(begin)
            except (BusError, RequestError) as error:
                log.debug("history could not be asked: %s", error)
                if isinstance(error, RequestError):
                    self._problem = f"the sampler does not give the pairs from {begin} on: {error}"
                self._retry_at = self._clock.now() + RETRY_S
                return
            with self.lock:
                if begin == self._cursor + 1 and self._end_of(reply):
                    return

    def _end_of(self, reply: Page) -> bool:
        """Learn a page of history; True when there is nothing more to ask for."""
        if self._store not in (None, reply.store):
            self._meet_foreign(reply.store)
            self._behind = False
            return True
        if reply.last_seq < self._cursor:
            self._problem = (
                f"the sampler's store ends at pair {reply.last_seq}, but {self._cursor} were learnt: it is an older "
                "copy. Put the newer one back, or send the command reset_to_prior"
            )
            self._foreign, self._behind = reply.store, False
            return True
        self._problem = self._foreign = None
        new = [message for message in reply.pairs if message.seq > self._cursor]
        for message in new:
            self._beat()
            self._pass_over(message.seq - self._cursor - 1)
            self._learnt(message)
            self._store, self._cursor = reply.store, message.seq
        self._learning.recovered(len(new))
        self._behind = self._cursor < reply.last_seq and bool(new)
        return not self._behind

    def _pass_over(self, missing: int) -> None:
        """Go on where the sampler has no such pairs: it numbers without gaps, so it had them once."""
        if missing > 0:
            log.warning(
                "the sampler has no pairs %d to %d any more: they were deleted ([daemon] keep_days, keep_mb) or its "
                "disk changed them (its health tells); learning goes on with the next",
                self._cursor + 1,
                self._cursor + missing,
            )
            self._learning.missed(missing)

    def _learnt(self, message: PairMessage | Unreadable) -> bool:
        try:
            if isinstance(message, Unreadable):
                raise RequestError(message.why)
            self._learning.learn(pair_from_wire(message, self._joints), self._clock.now())
        except RequestError as error:
            self._refuse(error)
            return False
        return True

    def _refuse(self, error: RequestError) -> None:
        log.warning("a pair was refused: %s", error)
        self._refused = str(error)
        self._learning.refuse()

    def _meet_foreign(self, store: str) -> None:
        self._foreign = store
        self._problem = (
            f"pairs now come from the store {store}, but this learner learnt from {self._store}; they are not mixed. "
            "Send the command reset_to_prior to begin anew with the new store, or put the old store back"
        )
