"""Layout of a pair store: its tables, the migration of each older schema, and the validity checks."""

from __future__ import annotations

import contextlib
import sqlite3
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec

from bodyschema.interfaces.errors import StoreError

from .file import NOTHING_CHANGED, damaged, is_damage
from .rows import COLUMNS, DamagedRow, checksum, decoded

SCHEMA_VERSION = 5
WITH_DEVICES, WITH_ORIENTATION, WITH_CHECKSUMS = 2, 3, 5
CHECKSUM = "checksum"  # a column of each table, and a key of `meta`
GIVEN_UP_TO = "given_up_to"  # a key of `meta`: pairs up to this number may have been numbered, and are lost
NUMBERS = ("seq", "id", "session", "segment", "t", "from_seq")  # columns that are not texts


class _Settings:
    longest_identity = 100  # characters; a UUID has 36
    largest_value_bytes = 2**26  # of one row; URDF and robot.toml of a session are the largest
    steps_until_told = 100_000  # of SQLite's machine; it does some millions in a second


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
# The statements that migrate to each schema from the previous one. Schema 2: devices that read the joints from pair
# `from_seq` on. Schema 3: the marker's orientation. Schema 4, no statements: the oldest pairs may have been deleted,
# which an older bodyschema takes for damage. Schema 5: a checksum of each row.
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
    5: """
ALTER TABLE pairs ADD COLUMN checksum INTEGER;
ALTER TABLE devices ADD COLUMN checksum INTEGER;
ALTER TABLE sessions ADD COLUMN checksum INTEGER""",
}
# By table, the statement that inserts a sealed row. An existing row with that number was damaged, because a store never
# assigns a number twice.
INSERT = {
    table: f"INSERT OR REPLACE INTO {table} ({names}, {CHECKSUM}) VALUES ({'?, ' * len(names.split(', '))}?)"
    for table, names in COLUMNS.items()
}
# Unreadable pairs get no checksum when an older store is migrated to schema 5.
_SEAL = "UPDATE {table} SET checksum = sealed_{table}({columns})"


def statements_of(schema: int) -> list[str]:
    """Return the statements that create the tables of a schema."""
    return ";".join([_TABLES, *(_MIGRATIONS[each] for each in _MIGRATIONS if each <= schema)]).split(";")


def connect(file: Path, *, readonly: bool = False) -> sqlite3.Connection:
    """Return a connection for any thread, without implicit transactions. Texts are returned as bytes.

    Objects defined in the file (triggers, generated columns) may not call functions with side effects.
    """
    if file.exists() and not file.is_file():  # SQLite would block on a pipe
        raise StoreError(f"{file} is not a file. Move it away, or give another --state-dir. {NOTHING_CHANGED}")
    uri = f"{file.absolute().as_uri()}?mode={'ro' if readonly else 'rwc'}"
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
    connection.text_factory = bytes  # a text that is not UTF-8 then affects its own row only
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _Settings.largest_value_bytes)
    connection.execute("PRAGMA trusted_schema = OFF")
    return connection


@contextmanager
def told_while_working(connection: sqlite3.Connection, working: Callable[[], None]) -> Iterator[None]:
    """Call `working` repeatedly while SQLite runs statements on this connection."""
    connection.set_progress_handler(working, _Settings.steps_until_told)
    try:
        yield
    finally:
        with contextlib.suppress(sqlite3.ProgrammingError):  # the connection is closed
            connection.set_progress_handler(None, 0)


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """Run the statements atomically."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with contextlib.suppress(sqlite3.Error):  # a full disk has already rolled back
            connection.execute("ROLLBACK")
        raise


def check_kind(connection: sqlite3.Connection, file: Path) -> None:
    """Raise StoreError if `file` is not a pair store, has a newer version, or has other tables."""
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise StoreError(
            f"{file} is not a sample store but another SQLite file. Move it away, or give another --state-dir. "
            f"{NOTHING_CHANGED}"
        )
    found = version(connection)
    if found > SCHEMA_VERSION:
        raise StoreError(
            f"{file} was written by a newer bodyschema (schema {found}, this one knows {SCHEMA_VERSION}). "
            f"Install the newer bodyschema, or give another --state-dir. {NOTHING_CHANGED}"
        )
    mismatch = _schema_mismatch(connection, found)
    if mismatch is not None:
        raise StoreError(damaged(file, mismatch))


def version(connection: sqlite3.Connection) -> int:
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def columns(schema: int) -> str:
    """Return the columns of `pairs` and its checksum that exist in this schema."""
    have = _pair_columns(schema)
    return ", ".join(name if name in have else "NULL" for name in [*COLUMNS["pairs"].split(", "), CHECKSUM])


def migrate(connection: sqlite3.Connection) -> None:
    """Migrate an older store to the present schema in one transaction; its pairs are unchanged."""
    found = version(connection)
    if found < SCHEMA_VERSION:
        with transaction(connection):
            for schema in range(found + 1, SCHEMA_VERSION + 1):
                for statement in _MIGRATIONS[schema].split(";"):
                    connection.execute(statement)
            if found < WITH_CHECKSUMS:
                _seal(connection)
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


def trouble(connection: sqlite3.Connection) -> str | None:
    """Return the problem with the file's pages or its identity, or None."""
    try:
        found = connection.execute("PRAGMA quick_check(1)").fetchone()[0].decode(errors="replace")
        if found == "ok":
            meta(connection)
    except sqlite3.DatabaseError as error:
        if not is_damage(error):
            raise
        return str(error)
    except ValueError as error:
        return str(error)
    return None if found == "ok" else found.splitlines()[-1]


def meta(connection: sqlite3.Connection) -> dict[str, str]:
    """Return the properties of the whole store: `store`, its identity, `joints` and more.

    Raises:
        ValueError: the disk corrupted it, or a part is missing.
    """
    rows = connection.execute("SELECT key, value FROM meta LIMIT 100").fetchall()
    try:
        found = {key.decode(): value.decode() for key, value in rows}
        sealed = version(connection) < WITH_CHECKSUMS or found.pop(CHECKSUM) == str(_checksum_of(found))
        if not (sealed and found["store"].isprintable() and 0 < len(found["store"]) <= _Settings.longest_identity):
            raise ValueError
        joints_of(found)
        given_up_to(found)
    except (AttributeError, KeyError, ValueError) as error:
        raise ValueError("its identity or its joints cannot be read") from error
    return found


def new_meta(joints: Sequence[str], utc: str) -> dict[str, str]:
    return {"store": str(uuid.uuid4()), "created_utc": utc, "joints": msgspec.json.encode(joints).decode()}


def joints_of(meta: dict[str, str]) -> tuple[str, ...]:
    """Return the names in the order of q; raise ValueError if they are not names."""
    try:
        joints = msgspec.json.decode(meta["joints"], type=tuple[str, ...])
    except msgspec.DecodeError as error:
        raise ValueError from error
    if not joints or len(set(joints)) != len(joints) or not all(name.isprintable() and name for name in joints):
        raise ValueError
    return joints


def given_up_to(meta: dict[str, str]) -> int:
    """Return the largest possible number of a lost pair; 0 if none is lost; raise ValueError if it is not a number."""
    number = int(meta.get(GIVEN_UP_TO, "0"))
    if not 0 <= number < 2**62:
        raise ValueError
    return number


def write_meta(connection: sqlite3.Connection, contents: dict[str, str]) -> None:
    """Write these properties of the whole store, inside a transaction."""
    rows = {**contents, CHECKSUM: str(_checksum_of(contents))} if version(connection) >= WITH_CHECKSUMS else contents
    connection.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", rows.items())


def create(connection: sqlite3.Connection, contents: dict[str, str]) -> None:
    with transaction(connection):
        for statement in statements_of(SCHEMA_VERSION):
            connection.execute(statement)
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        write_meta(connection, contents)


def _pair_columns(schema: int) -> list[str]:
    names = COLUMNS["pairs"].split(", ")
    turned = names if schema >= WITH_ORIENTATION else names[: names.index("R")]
    return [*turned, CHECKSUM] if schema >= WITH_CHECKSUMS else turned


def _schema_mismatch(connection: sqlite3.Connection, schema: int) -> str | None:
    """Return a difference between the file and a pair store of this schema, or None."""
    if connection.execute("PRAGMA encoding").fetchone()[0] != b"UTF-8":
        return "its texts are not UTF-8"
    trigger = connection.execute("SELECT name FROM sqlite_schema WHERE type = 'trigger'").fetchone()
    if trigger is not None:
        return "it has a trigger, which a sample store has not"
    with contextlib.closing(sqlite3.connect(":memory:")) as sound:
        sound.text_factory = bytes
        for statement in statements_of(schema):
            sound.execute(statement)
        expected, there = _tables(sound), _tables(connection)
    mismatch = next((table for table, columns in expected.items() if there.get(table) != columns), None)
    return None if mismatch is None else f"its table {mismatch.decode()} is not that of schema {schema}"


def _tables(connection: sqlite3.Connection) -> dict[bytes, list[tuple[object, ...]]]:
    """Return the columns of each table: name, type, constraints, and whether it is computed."""
    found = [row[1] for row in connection.execute("PRAGMA table_list") if row[2] == b"table"]
    return {
        name: connection.execute("SELECT * FROM pragma_table_xinfo(?)", (name.decode(),)).fetchall() for name in found
    }


def _seal(connection: sqlite3.Connection) -> None:
    """Add its checksum to each row. An unreadable pair gets none."""
    contents = meta(connection)
    joints = len(joints_of(contents))

    def sealed_pairs(*row: object) -> int | None:
        try:
            decoded(row, joints)
        except DamagedRow:
            return None
        return checksum(row)

    functions = {"pairs": sealed_pairs, "devices": lambda *row: checksum(row), "sessions": lambda *row: checksum(row)}
    for table, function in functions.items():
        names = COLUMNS[table].split(", ")
        connection.create_function(f"sealed_{table}", len(names), function, deterministic=True)
        # As bytes, because a text that is not UTF-8 would abort the statement.
        texts = [name if name in NUMBERS else f"CAST({name} AS BLOB)" for name in names]
        connection.execute(_SEAL.format(table=table, columns=", ".join(texts)))
    connection.execute("INSERT INTO meta VALUES (?, ?)", (CHECKSUM, str(_checksum_of(contents))))


def _checksum_of(contents: dict[str, str]) -> int:
    return checksum(tuple(part.encode() for item in sorted(contents.items()) for part in item))
