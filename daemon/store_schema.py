"""How a pair store is laid out: its tables, the way from each older schema to this one, and what makes it sound."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from interfaces.errors import StoreError

from .store_file import NOTHING_CHANGED, damaged

SCHEMA_VERSION = 4
MAY_BE_TRIMMED = 4
APPLICATION_ID = 0x42534348  # "BSCH": how `file` and we tell a pair store from another SQLite file

_TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE sessions (
    id INTEGER PRIMARY KEY, started_utc TEXT NOT NULL, robot_toml TEXT NOT NULL, urdf TEXT NOT NULL,
    config TEXT NOT NULL, version TEXT NOT NULL, host TEXT NOT NULL
);
CREATE TABLE pairs (
    seq INTEGER PRIMARY KEY, session INTEGER NOT NULL REFERENCES sessions, segment INTEGER NOT NULL,
    t REAL NOT NULL, utc TEXT NOT NULL, q TEXT NOT NULL, x TEXT NOT NULL, cov TEXT NOT NULL, centres_px TEXT
);
"""
# The statements that lead to each schema from the one before. Those of schema 2: what the joints were read with from
# pair `from_seq` on. Of schema 3: how the marker is turned. Of schema 4 none: its oldest pairs may have been deleted,
# which an older bodyschema takes for damage.
_MIGRATIONS = {
    2: """
CREATE TABLE devices (
    id INTEGER PRIMARY KEY, session INTEGER NOT NULL REFERENCES sessions, from_seq INTEGER NOT NULL, utc TEXT NOT NULL,
    record TEXT NOT NULL
)""",
    3: """
ALTER TABLE pairs ADD COLUMN R TEXT;
ALTER TABLE pairs ADD COLUMN cov_R TEXT""",
    4: "",
}
TABLES = ";".join([_TABLES, *_MIGRATIONS.values()]).split(";")


def connect(file: Path, *, readonly: bool = False) -> sqlite3.Connection:
    """A connection for any thread, without transactions of its own."""
    uri = f"{file.absolute().as_uri()}?mode={'ro' if readonly else 'rwc'}"
    return sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """All of it or nothing."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with contextlib.suppress(sqlite3.Error):  # a full disk has rolled back already
            connection.execute("ROLLBACK")
        raise


def check_kind(connection: sqlite3.Connection, file: Path) -> None:
    """StoreError when `file` is no pair store, or one of a newer version."""
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise StoreError(
            f"{file} is not a pair store but another SQLite file. Move it away, or give another --state-dir. "
            f"{NOTHING_CHANGED}"
        )
    found = version(connection)
    if found > SCHEMA_VERSION:
        raise StoreError(
            f"{file} was written by a newer bodyschema (schema {found}, this one knows {SCHEMA_VERSION}). "
            f"Install the newer bodyschema, or give another --state-dir. {NOTHING_CHANGED}"
        )


def version(connection: sqlite3.Connection) -> int:
    """The schema of the file."""
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def migrate(connection: sqlite3.Connection) -> None:
    """Bring a store of an older version to this one; its pairs stay as they are."""
    found = version(connection)
    if found < SCHEMA_VERSION:
        with transaction(connection):
            for schema in range(found + 1, SCHEMA_VERSION + 1):
                for statement in _MIGRATIONS[schema].split(";"):
                    connection.execute(statement)
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


def check_health(connection: sqlite3.Connection, file: Path) -> None:
    """StoreError when the file is damaged, or a pair is missing between its oldest and its newest."""
    found = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    count, oldest, newest = connection.execute(
        "SELECT count(*), coalesce(min(seq), 1), coalesce(max(seq), 0) FROM pairs"
    ).fetchone()
    missing = newest - oldest + 1 - count + (oldest - 1 if version(connection) < MAY_BE_TRIMMED else 0)
    if found != "ok" or missing:
        what = found if found != "ok" else f"{missing} pairs are missing"
        raise StoreError(damaged(file, what))


def meta(connection: sqlite3.Connection) -> dict[str, str]:
    """What is said of the store as a whole."""
    return dict(connection.execute("SELECT key, value FROM meta").fetchall())
