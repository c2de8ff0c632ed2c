"""Reopen sources after their device went away."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Generic, Protocol, Self, TypeVar

from bodyschema.interfaces.errors import SourceError, SourceLost
from bodyschema.interfaces.protocols import Clock, Source
from bodyschema.interfaces.waits import Waits

log = logging.getLogger(__name__)


R_co = TypeVar("R_co", covariant=True)


class Readable(Source, Protocol[R_co]):
    """A source of any kind."""

    def read(self, timeout_s: float) -> R_co | None: ...


class ReconnectingSource(Generic[R_co]):
    """Reader of a source that reports a loss once and tries to reopen the source at growing intervals.

    A wrong source (other cameras, another servo) is reported too, and reopening continues. The source counts as back
    once it was read, since a device may open without being readable.

    The first opening has to succeed, since a failure at the start needs a person.
    """

    def __init__(
        self,
        source: Readable[R_co],
        name: str,
        wall: Clock,
        sleep: Callable[[float], None] = time.sleep,
        # returns a device that this process will never be allowed to open, or None
        forbidden: Callable[[], str | None] = lambda: None,
        # called after each opening; raises SourceError for a wrong device
        require: Callable[[], None] = lambda: None,
    ) -> None:
        self._forbidden, self._require = forbidden, require
        self._source, self._name, self._wall, self._sleep = source, name, wall, sleep
        self._opened = ExitStack()
        self._wait_s = Waits.first_s
        self._next_try = 0.0
        self._is_open = False
        self._last_refusal = ""
        self.trouble: str | None = None
        self.losses = 0

    def __enter__(self) -> Self:
        self._open()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def _open(self) -> None:
        with ExitStack() as stack:
            stack.enter_context(self._source)
            self._require()
            self._opened = stack.pop_all()
        self._is_open = True

    @property
    def health(self) -> tuple[str, ...]:
        return () if self.trouble is None else (self.trouble,)

    def read(self, timeout_s: float) -> R_co | None:
        """Read like the source's `read`; also return None while the source is lost.

        Raises:
            SourceError: it came back as a device that only a new process may open.
        """
        if not self._is_open and not self._try_again(timeout_s):
            return None
        try:
            value = self._source.read(timeout_s)
        except SourceLost as error:
            self._opened.close()
            self._note_loss(error)
            return None
        if value is not None and self.trouble is not None:
            log.info("%s are back", self._name)
            self.trouble, self._wait_s, self._last_refusal = None, Waits.first_s, ""
        return value

    def _try_again(self, timeout_s: float) -> bool:
        remaining_s = self._next_try - self._wall.now()
        if remaining_s > 0:
            self._sleep(min(remaining_s, timeout_s))
            return False
        try:
            self._open()
        except SourceError as error:
            self._note_loss(error)
            device = self._forbidden()
            if device is None:
                return False
            raise SourceError(
                f"{device} came back as another device, which only a new start of this process may open ({error})"
            ) from error
        return True

    def _note_loss(self, error: SourceError) -> None:
        if self.trouble is None:
            log.warning("%s are lost: %s; trying to open them again", self._name, error)
            self.losses += 1
        else:
            self._wait_s = min(2 * self._wait_s, Waits.longest_s)
            # Problems that need a person are logged, each once.
            if not isinstance(error, SourceLost) and str(error) != self._last_refusal:
                self._last_refusal = str(error)
                log.warning("%s cannot be taken again: %s; trying on", self._name, error)
        self._is_open = False
        reason = error.brief if isinstance(error, SourceLost) else error
        self.trouble = f"{self._name} are lost ({reason}); trying to open them again"
        retry_s = error.retry_s if isinstance(error, SourceLost) else None
        self._next_try = self._wall.now() + (self._wait_s if retry_s is None else retry_s)
