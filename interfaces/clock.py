"""The machine's own clock."""

from __future__ import annotations

import time
from datetime import UTC, datetime


class SystemClock:
    """The machine's monotonic and wall clocks."""

    def now(self) -> float:
        """Return the monotonic time [s]."""
        return time.monotonic()

    def utc(self) -> str:
        """Return the wall-clock time, ISO 8601 in UTC."""
        return datetime.now(UTC).isoformat(timespec="milliseconds")
