"""Select the pairs that a store deletes: the oldest, by age and size, and never the newest."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from datetime import datetime, timedelta

AT_ONCE = 500  # Batch size: deleting this many takes a few milliseconds, so no new pair waits long


@dataclass(frozen=True, slots=True)
class Keep:
    """Limits of the pairs that a store keeps."""

    days: float | None  # maximum age; None: any
    size: float | None  # maximum bytes of the file in use; None: unlimited
    # number of pairs kept whatever their age and size, so that a wall clock that jumps ahead cannot delete all
    newest: int = 20_000

    def last_to_delete(self, connection: sqlite3.Connection, utc: str, newest: int) -> int | None:
        """Return the newest pair that can be deleted now, with all before it; None to keep all.

        Args:
            newest: number of the newest pair; a damaged row may not contain it.
        """
        if self.days is None and self.size is None:
            return None
        oldest = connection.execute("SELECT min(seq) FROM pairs").fetchone()[0]
        if oldest is None or newest - self.newest < oldest:
            return None
        end = min(newest - self.newest, oldest + AT_ONCE - 1)
        if self.size is not None and used_bytes(connection) > self.size:
            return end
        return None if self.days is None else _last_before(connection, oldest, end, _earlier(utc, self.days))


def delete_until(connection: sqlite3.Connection, last: int) -> int:
    """Delete the pairs up to `last`, and records that refer only to them; return the number of pairs deleted."""
    deleted = connection.execute("DELETE FROM pairs WHERE seq <= ?", (last,)).rowcount
    # A device record holds until the next one: keep the newest before the first remaining pair.
    connection.execute(
        "DELETE FROM devices WHERE from_seq < (SELECT max(from_seq) FROM devices WHERE from_seq <= ?)", (last + 1,)
    )
    # Count rows, as the disk may have corrupted one.
    connection.execute(
        "DELETE FROM sessions WHERE id < (SELECT min(session) FROM (SELECT session FROM pairs ORDER BY seq LIMIT 10)) "
        "AND id NOT IN (SELECT session FROM devices)"
    )
    return deleted


def used_bytes(connection: sqlite3.Connection) -> int:
    """Return the used bytes of the file, without free pages."""
    pages, free, size = (
        connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "freelist_count", "page_size")
    )
    return (pages - free) * size


def _last_before(connection: sqlite3.Connection, first: int, last: int, utc: str) -> int | None:
    """Return the newest pair from `first` to `last` such that it and all before it were measured before `utc`."""
    young = connection.execute(
        "SELECT min(seq) FROM pairs WHERE seq BETWEEN ? AND ? AND utc >= ?", (first, last, utc)
    ).fetchone()[0]
    if young is None:
        return last
    return None if young == first else young - 1


def _earlier(utc: str, days: float) -> str:
    """Return the time `days` days before `utc`, in the format of the pairs, in which texts sort like times."""
    return (datetime.fromisoformat(utc) - timedelta(days=days)).isoformat(timespec="milliseconds")
