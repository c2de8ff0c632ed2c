"""Where log lines go: to systemd's journal with priorities, or to a person's terminal."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Mapping
from typing import TextIO

from .remedies import as_typed

# sd-daemon(3): the journal reads a line's priority from its head.
_PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))


class PlainFormatter(logging.Formatter):
    """Commands in the lines are as who started this has to type them."""

    def format(self, record: logging.LogRecord) -> str:
        """The record."""
        return as_typed(super().format(record))


class JournalFormatter(PlainFormatter):
    """Lines with a priority like `<4>` at the head of each and without a time: the journal has its own."""

    def format(self, record: logging.LogRecord) -> str:
        """The record, every line of it with its priority."""
        priority = next((number for level, number in _PRIORITIES if record.levelno >= level), 7)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())


def set_up(*, verbose: bool = False, environment: Mapping[str, str] = os.environ, stream: TextIO | None = None) -> None:
    """Send the log to `stream` (stderr): with priorities under systemd (JOURNAL_STREAM), else with times."""
    handler = logging.StreamHandler(stream if stream is not None else sys.stderr)
    if "JOURNAL_STREAM" in environment:
        handler.setFormatter(JournalFormatter("%(name)s: %(message)s"))
    else:
        handler.setFormatter(PlainFormatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s", "%H:%M:%S"))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.DEBUG if verbose else logging.INFO)
