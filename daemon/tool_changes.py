"""Which change of the tool was the last, for the log and for the status."""

from __future__ import annotations

import logging

from .learning.state import Counters
from .status import ToolChange

log = logging.getLogger(__name__)


class ToolChanges:
    """Notices by the learner's counters that the tool was changed. Not to be used by two threads at once."""

    def __init__(self, counters: Counters) -> None:
        """From these counters on; what they have counted already is not told."""
        self._changes = counters.changes
        self._last: ToolChange | None = None

    @property
    def last(self) -> ToolChange | None:
        """The last change, or None."""
        return self._last

    def note(self, counters: Counters, *, found: bool) -> None:
        """Keep and log what changed the tool, if something did since the last call.

        Args:
            found: in the pairs; else it was told.
        """
        if counters.changes == self._changes:
            return
        self._changes = counters.changes
        self._last = ToolChange(counters.last_seq - counters.since_change + 1, found)
        log.info("tool changed at pair %d (%s)", self._last.first_seq, "found" if found else "told")

    def forget(self, counters: Counters) -> None:
        """Learning has begun anew."""
        self._changes, self._last = counters.changes, None
