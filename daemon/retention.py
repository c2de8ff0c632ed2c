"""Which pairs a store lets go: the oldest, by age and by size, and never the newest."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Self

from .config import DaemonConfig

# At a time, so that no pair waits long for its turn: a delete of so many takes a few milliseconds.
AT_ONCE = 500


@dataclass(frozen=True, slots=True)
class Keep:
    """What is kept of a store.

    Attributes:
        days: of this age at most; None: of any.
        size: bytes of the file in use; None: as many as there are.
        newest: so many pairs whatever their age and size. A wall clock that jumps ahead makes all pairs old: these
            stay.
    """

    days: float | None
    size: float | None
    newest: int

    @classmethod
    def of(cls, rules: DaemonConfig) -> Self:
        """As the table [daemon] says."""
        return cls(rules.keep_days, None if rules.keep_mb is None else 1e6 * rules.keep_mb, rules.keep_newest)

    def last_to_delete(self, connection: sqlite3.Connection, utc: str, newest: int) -> int | None:
        """Return the newest pair that can go now, with all before it; None when all are to be kept.

        Args:
            utc: now.
            newest: number of the newest pair, which a damaged row may not tell.
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
    """Delete the pairs up to `last`, and what tells of none but them; how many pairs there were."""
    deleted = connection.execute("DELETE FROM pairs WHERE seq <= ?", (last,)).rowcount
    # What the joints are read with holds until the next entry: the newest before the first pair that is left stays.
    connection.execute(
        "DELETE FROM devices WHERE from_seq < (SELECT max(from_seq) FROM devices WHERE from_seq <= ?)", (last + 1,)
    )
    # Of several rows: the disk may have changed one.
    connection.execute(
        "DELETE FROM sessions WHERE id < (SELECT min(session) FROM (SELECT session FROM pairs ORDER BY seq LIMIT 10)) "
        "AND id NOT IN (SELECT session FROM devices)"
    )
    return deleted


def used_bytes(connection: sqlite3.Connection) -> int:
    """Of the file, without the pages that deleted pairs left and new ones take."""
    pages, free, size = (
        connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "freelist_count", "page_size")
    )
    return (pages - free) * size


def _last_before(connection: sqlite3.Connection, first: int, last: int, utc: str) -> int | None:
    """The newest of the pairs from `first` to `last` such that all of them to it were measured before `utc`."""
    young = connection.execute(
        "SELECT min(seq) FROM pairs WHERE seq BETWEEN ? AND ? AND utc >= ?", (first, last, utc)
    ).fetchone()[0]
    if young is None:
        return last
    return None if young == first else young - 1


def _earlier(utc: str, days: float) -> str:
    """The time so many days before `utc`, as pairs have theirs: the texts sort as the times do."""
    return (datetime.fromisoformat(utc) - timedelta(days=days)).isoformat(timespec="milliseconds")
