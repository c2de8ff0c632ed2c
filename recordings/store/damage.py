"""Recover the pairs of a damaged file: sound rows, lost numbers, and a new file with the remaining pairs."""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, TypeVar

from bodyschema.interfaces.whole_files import sync_folder, unused_name

from . import schema as store_schema
from .file import is_damage
from .rows import COLUMNS, DamagedRow, decoded, require_sound, sealed


class _Settings:
    # After this many unreadable numbers in a row, the search for the next readable one takes growing steps: a damaged
    # page holds some ten pairs, one above it some thousand. A larger value takes longer, a smaller one skips more.
    patience = 64
    # Lower bound for a row of `pairs`. Pages linked in a circle yield more rows than fit into the file.
    smallest_row_bytes = 20
    # Numbers left free after the newest readable pair where SQLite lost the end of the store, because they may have
    # been used. A page of 4096 bytes holds at most 37 pairs.
    left_free = 50
    shown = 8  # damaged places listed in a sentence


Made = TypeVar("Made")
Make = Callable[[tuple[Any, ...]], Made]


@dataclass(frozen=True, slots=True)
class Damage:
    """Numbers of lost pairs of a store: ranges, ascending, both ends inclusive."""

    ranges: tuple[tuple[int, int], ...] = ()

    @classmethod
    def between(cls, numbers: Iterable[int]) -> Damage:
        """Return the numbers missing from an ascending sequence."""
        return cls(tuple((one + 1, next_one - 1) for one, next_one in pairwise(numbers) if next_one > one + 1))

    @property
    def count(self) -> int:
        """Number of lost pairs."""
        return sum(last - first + 1 for first, last in self.ranges)

    def sentence(self, file: Path) -> str:
        """Return a sentence with the numbers and the remedy."""
        one = self.count == 1
        many, they = ("1 sample", "It is") if one else (f"{self.count} samples", "They are")
        return (
            f"{many} of {file} cannot be read: the disk changed what was written. {they} left out "
            f"(number{'' if one else 's'} {self}). Check the disk and write a backup"
        )

    def __or__(self, other: Damage) -> Damage:
        joined: list[tuple[int, int]] = []
        for first, last in sorted(self.ranges + other.ranges):
            if joined and first <= joined[-1][1] + 1:
                joined[-1] = joined[-1][0], max(last, joined[-1][1])
            else:
                joined.append((first, last))
        return Damage(tuple(joined))

    def since(self, oldest: int) -> Damage:
        """Return the part from the number `oldest` on."""
        return Damage(tuple((max(first, oldest), last) for first, last in self.ranges if last >= oldest))

    def __str__(self) -> str:
        shown = [str(a) if a == b else f"{a} to {b}" for a, b in self.ranges[: _Settings.shown]]
        more = len(self.ranges) - _Settings.shown
        return ", ".join(shown) + (f" and at {more} other places" if more > 0 else "")


def scan(connection: sqlite3.Connection, columns: str, make: Make[Made], first: int = 1) -> Iterator[Made]:
    """Yield `make(row)` for each sound row of `pairs` from number `first` on, each once and in order.

    Args:
        make: raises DamagedRow if a row is not sound. Such rows, and rows that SQLite cannot read, are skipped.
    """
    statement = f"SELECT {columns} FROM pairs WHERE seq >= ? ORDER BY seq LIMIT ?"
    position, failed_at = first, None
    while position < 2**62:
        try:
            for row in _rows(connection, statement, position):
                try:
                    made = make(row)
                except DamagedRow:
                    continue
                if row[0] >= position:
                    yield made
                    position, failed_at = row[0] + 1, None
            return
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
        failed_at = position if failed_at is None else failed_at
        position += 1 + (position - failed_at) // _Settings.patience


def scan_back(connection: sqlite3.Connection, columns: str, make: Make[Made]) -> Iterator[Made | None]:
    """Yield like `scan`, from the newest row backwards, and None for a row that is not sound.

    Raises:
        sqlite3.DatabaseError: SQLite cannot read further.
    """
    statement = f"SELECT {columns} FROM pairs WHERE seq <= ? ORDER BY seq DESC LIMIT ?"
    for row in _rows(connection, statement, 2**62):
        try:
            made = make(row)
        except DamagedRow:
            made = None
        yield made


def rebuild(file: Path, fresh: dict[str, str], working: Callable[[], None] = lambda: None) -> Path:
    """Replace a damaged store by a sound one of the present schema, with everything readable.

    Args:
        fresh: `meta` of a new store, in case the store's own is lost.

    Returns:
        Path under which the damaged store was kept.

    Raises:
        sqlite3.Error, OSError: the disk is full or failing; the damaged store is unchanged.
    """
    new = file.with_name(f".{file.name}.rebuilt-{uuid.uuid4().hex[:8]}")
    try:
        with closing(store_schema.connect(file)) as source:
            source.execute("PRAGMA journal_mode = DELETE")  # a log of the old file does not apply to the new one
            with closing(store_schema.connect(new)) as target:
                target.execute("PRAGMA synchronous = FULL")
                with store_schema.told_while_working(target, working):
                    _copy(source, target, fresh)
        kept = unused_name(file, "damaged")
        try:
            os.link(file, kept)
        except OSError:  # the file system has no hard links
            shutil.copyfile(file, kept)
        os.replace(new, file)
        sync_folder(file.parent)
    finally:
        for suffix in ("", "-journal"):
            new.with_name(new.name + suffix).unlink(missing_ok=True)
    return kept


def records(connection: sqlite3.Connection, table: str) -> Iterator[tuple[Any, ...] | None]:
    """Yield the rows of `devices` or `sessions` without their checksums, as far as SQLite can read them.

    None stands for a row that is not sound. Stores of the first schema have no devices.
    """
    schema = store_schema.version(connection)
    with_checksums = schema >= store_schema.WITH_CHECKSUMS
    if table == "devices" and schema < store_schema.WITH_DEVICES:
        return
    try:
        last = store_schema.CHECKSUM if with_checksums else "NULL"
        statement = f"SELECT {COLUMNS[table]}, {last} FROM {table} ORDER BY id LIMIT ?"
        for row in connection.execute(statement, (_max_rows(connection),)):
            try:
                if with_checksums:
                    require_sound(row)
            except DamagedRow:
                yield None
            else:
                yield row[:-1]
    except sqlite3.DatabaseError as error:
        if not is_damage(error):
            raise


def oldest(connection: sqlite3.Connection) -> int:
    """Return the number of the oldest row of `pairs`; 1 if SQLite can read none."""
    return _one(connection, "SELECT coalesce(min(seq), 1) FROM pairs", 1)


def count_pairs(connection: sqlite3.Connection, otherwise: int) -> int:
    """Return the number of rows of `pairs`, sound or not; `otherwise` if SQLite cannot count them."""
    return _one(connection, "SELECT count(*) FROM pairs", otherwise)


def _one(connection: sqlite3.Connection, statement: str, otherwise: int) -> int:
    try:
        return connection.execute(statement).fetchone()[0]
    except sqlite3.DatabaseError as error:
        if not is_damage(error):
            raise
        return otherwise


def _copy(source: sqlite3.Connection, target: sqlite3.Connection, fresh: dict[str, str]) -> None:
    try:
        contents = store_schema.meta(source)
    except (ValueError, sqlite3.DatabaseError):
        contents = fresh
    joints, schema = len(store_schema.joints_of(contents)), store_schema.version(source)

    def make(row: tuple[Any, ...]) -> tuple[Any, ...]:
        if schema >= store_schema.WITH_CHECKSUMS:
            require_sound(row)
        decoded(row[:-1], joints)
        return row[:-1]

    columns = store_schema.columns(schema)
    store_schema.create(target, contents)
    with store_schema.transaction(target):
        target.executemany(store_schema.INSERT["pairs"], map(_resealed, scan(source, columns, make)))
        bad, bad_at_end = 0, None
        try:
            for row in scan_back(source, columns, make):
                if row is None:
                    bad += 1
                    continue
                bad_at_end = bad if bad_at_end is None else bad_at_end
                target.execute(store_schema.INSERT["pairs"], _resealed(row))
            bad_at_end = bad if bad_at_end is None else bad_at_end
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
        for table in ("sessions", "devices"):
            sound = (row for row in records(source, table) if row is not None)
            target.executemany(store_schema.INSERT[table], map(_resealed, sound))
        newest = target.execute("SELECT coalesce(max(seq), 0) FROM pairs").fetchone()[0]
        used_up_to = max(
            store_schema.given_up_to(contents), newest + (_Settings.left_free if bad_at_end is None else bad_at_end)
        )
        store_schema.write_meta(target, {**contents, store_schema.GIVEN_UP_TO: str(used_up_to)})


def _resealed(row: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the sealed row, with bytes decoded to text."""
    return sealed(tuple(value.decode(errors="replace") if isinstance(value, bytes) else value for value in row))


def _rows(connection: sqlite3.Connection, statement: str, start: int) -> Iterator[tuple[Any, ...]]:
    """Yield rows as far as SQLite can read them, then raise its error.

    Python's sqlite3 does not return the row before an unreadable one, so that row is requested again as the last one.
    """
    count = 0
    try:
        with closing(connection.execute(statement, (start, _max_rows(connection)))) as rows:
            for row in rows:
                count += 1
                yield row
        return
    except sqlite3.DatabaseError as error:
        if not is_damage(error):
            raise
        failure = error
    with contextlib.suppress(sqlite3.DatabaseError), closing(connection.execute(statement, (start, count + 1))) as rows:
        yield from islice(rows, count, None)
    raise failure


def _max_rows(connection: sqlite3.Connection) -> int:
    pages, size = (connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "page_size"))
    return pages * size // _Settings.smallest_row_bytes
