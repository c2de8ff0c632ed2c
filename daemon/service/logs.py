"""Send log lines to systemd's journal with priorities, or to a terminal."""

from __future__ import annotations

import faulthandler
import logging
import os
import re
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TextIO

from .remedies import as_typed

# sd-daemon(3): the journal reads a line's priority from its head.
_PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))


class RepeatSettings:
    repeated_s: float = 60.0  # the same text is not logged again within this time
    often: int = 20  # messages that differ only in numbers may appear this often in that time
    remembered: int = 256  # texts


_NUMBER = re.compile(r"\d+")
# Clients of the page, a loose plug, and a disk that is full again after each pair cause messages without end.
_FLOODED = ("uvicorn", "bodyschema.daemon.sampler.pair_writer", "bodyschema.daemon.sampler.reconnect")


class PlainFormatter(logging.Formatter):
    """Formatter that shows commands as the user has to type them."""

    def format(self, record: logging.LogRecord) -> str:
        return as_typed(super().format(record))


class JournalFormatter(PlainFormatter):
    """Formatter of an event as one line with a priority such as `<4>`, without a time, which the journal adds."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the formatted record; several lines, as in a traceback, are joined into one."""
        priority = next((number for level, number in _PRIORITIES if record.levelno >= level), 7)
        lines = (line.strip() for line in super().format(record).splitlines())
        return f"<{priority}>{' | '.join(line for line in lines if line)}"


@dataclass(slots=True)
class _RepeatedMessage:
    since: float
    limit: int
    count: int = 0


class UnrepeatedHandler(logging.StreamHandler[TextIO]):
    """Handler that suppresses repeats: the same text within `repeated_s`, or more than `often` similar texts.

    Texts are similar if they differ only in numbers. The number of suppressed messages is logged with the next record
    after that time, and at the end.
    """

    def __init__(self, stream: TextIO, formatter: logging.Formatter, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream)
        self.setFormatter(formatter)
        self._now = now
        self._recent: OrderedDict[tuple[str, int, str], _RepeatedMessage] = OrderedDict()

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record, unless it is a repeat."""
        self._forget_before(self._now() - RepeatSettings.repeated_s)
        if self._is_new(record):
            super().emit(record)

    def close(self) -> None:
        """Report the messages suppressed so far."""
        self._forget_before(self._now())
        super().close()

    def _is_new(self, record: logging.LogRecord) -> bool:
        text = record.getMessage()
        pattern = _NUMBER.sub("#", text)
        if pattern != text and (record.name, record.levelno, text) not in self._recent:
            repeated = self._entry(record, pattern)
            repeated.count += 1
            if repeated.count > RepeatSettings.often:
                return False
        repeated = self._entry(record, text)
        repeated.count += 1
        return repeated.count == 1

    def _entry(self, record: logging.LogRecord, text: str) -> _RepeatedMessage:
        key = (record.name, record.levelno, text)
        if key not in self._recent and len(self._recent) >= RepeatSettings.remembered:
            self._forget(next(iter(self._recent)))
        self._recent.setdefault(
            key, _RepeatedMessage(self._now(), RepeatSettings.often if text != record.getMessage() else 1)
        )
        self._recent.move_to_end(key)
        return self._recent[key]

    def _forget_before(self, moment: float) -> None:
        for key in [key for key, repeated in self._recent.items() if repeated.since <= moment]:
            self._forget(key)

    def _forget(self, key: tuple[str, int, str]) -> None:
        name, level, text = key
        repeated = self._recent.pop(key)
        if repeated.count > repeated.limit:
            summary = f"{repeated.count - repeated.limit} more times in {self._now() - repeated.since:.0f} s: {text}"
            super().emit(logging.LogRecord(name, level, "", 0, summary, None, None))


def set_up(*, verbose: bool = False, environment: Mapping[str, str] = os.environ, stream: TextIO | None = None) -> None:
    """Send the log to `stream` (stderr): under systemd with priorities and without repeats, otherwise with times."""
    out = sys.stderr if stream is None else stream
    if is_journal(out, environment):
        handler: logging.Handler = UnrepeatedHandler(out, JournalFormatter("%(name)s: %(message)s"))
        limited: list[logging.Handler] = []
        faulthandler.enable(out)  # shows the activity of each thread when the watchdog ends the process
    else:
        formatter = PlainFormatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s", "%H:%M:%S")
        handler = logging.StreamHandler(out)
        handler.setFormatter(formatter)
        limited = [UnrepeatedHandler(out, formatter)]
    for name in _FLOODED:
        flooded = logging.getLogger(name)
        flooded.handlers[:], flooded.propagate = limited, not limited
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.DEBUG if verbose else logging.INFO)


def is_journal(stream: TextIO, environment: Mapping[str, str]) -> bool:
    """Return True if `stream` ends in the journal.

    The variable alone is no proof, as terminals of a desktop inherit it.
    """
    try:
        status = os.fstat(stream.fileno())
    except OSError:
        return False
    return environment.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"
