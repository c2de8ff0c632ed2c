"""The pair store: one SQLite file, one transaction for each pair, one writer, any number of readers."""

from __future__ import annotations

import os
import sqlite3
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any, Self

import msgspec

from interfaces.errors import StoreError
from interfaces.records import FloatArray, MarkerFix, Pair, frozen_array

from . import store_schema
from .retention import Keep, delete_until
from .store_file import NOTHING_CHANGED, explained, lock
from .store_rows import COLUMNS, COLUMNS_BEFORE_ORIENTATION, as_json, pair_of, row_of


@dataclass(frozen=True, slots=True)
class Session:
    """What one run of the sampler worked with; kept beside the pairs so that they can be understood later.

    Attributes:
        joints: names in the order of q. They belong to the whole store: another order is another store.
        robot_toml, urdf: texts of the two files.
        config: all tables after overriding, as JSON.
    """

    joints: tuple[str, ...]
    started_utc: str
    robot_toml: str
    urdf: str
    config: str
    version: str
    host: str


@dataclass(frozen=True, slots=True)
class Devices:
    """What the joints were read with.

    Attributes:
        session: number of the run of the sampler.
        from_seq: from this pair on, until the next ones.
        record: of each joint: names and settings, as its driver tells them.
    """

    session: int
    from_seq: int
    utc: str
    record: tuple[dict[str, Any], ...]


class PairReader:
    """Reads a pair store, also while a sampler writes it. Use as a context manager; any thread may read.

    Attributes:
        identity: UUID of the store.
        joints: names in the order of q.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.identity = ""
        self.joints: tuple[str, ...] = ()
        self._connection: sqlite3.Connection | None = None
        self._columns = COLUMNS
        self._lock = Lock()

    def __enter__(self) -> Self:
        if not self.file.exists():
            raise StoreError(f"there is no store {self.file}. The sampler makes it: start it with `bodyschema sampler`")
        with explained(self.file):
            self._connection = store_schema.connect(self.file, readonly=True)
            try:
                store_schema.check_kind(self._connection, self.file)
                meta = store_schema.meta(self._connection)
                if store_schema.version(self._connection) < 3:
                    self._columns = COLUMNS_BEFORE_ORIENTATION
            except BaseException:
                self._close()
                raise
        self.identity, self.joints = meta["store"], tuple(msgspec.json.decode(meta["joints"]))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def read(self, from_seq: int = 1, to_seq: int | None = None, limit: int | None = None) -> list[Pair]:
        """Pairs `from_seq` to `to_seq` (inclusive; None: the newest) in order, at most `limit` of them.

        Raises:
            StoreError: the file cannot be read.
        """
        rows = self._rows(
            f"SELECT {self._columns} FROM pairs WHERE seq BETWEEN ? AND ? ORDER BY seq LIMIT ?",
            (from_seq, 2**62 if to_seq is None else to_seq, -1 if limit is None else limit),
        )
        return [pair_of(self.identity, row) for row in rows]

    def last(self) -> Pair | None:
        """The newest pair, or None when there is none."""
        rows = self._rows(f"SELECT {self._columns} FROM pairs ORDER BY seq DESC LIMIT 1", ())
        return pair_of(self.identity, rows[0]) if rows else None

    def last_seq(self) -> int:
        """Sequence number of the newest pair; 0 when there is none."""
        return self._rows("SELECT coalesce(max(seq), 0) FROM pairs", ())[0][0]

    def first_seq(self) -> int:
        """Sequence number of the oldest pair; 1 when there is none."""
        return self._rows("SELECT coalesce(min(seq), 1) FROM pairs", ())[0][0]

    def joint_ranges(self) -> tuple[FloatArray, FloatArray] | None:
        """Smallest and largest joint angles over all pairs, each shape (d,) [rad or m]; None when there is none."""
        columns = ", ".join(
            f"min(json_extract(q, '$[{i}]')), max(json_extract(q, '$[{i}]'))" for i in range(len(self.joints))
        )
        ranges = self._rows(f"SELECT {columns} FROM pairs", ())[0]
        return None if ranges[0] is None else (frozen_array(ranges[0::2]), frozen_array(ranges[1::2]))

    def devices(self) -> list[Devices]:
        """What the joints were read with, in the order of the pairs; empty in a store that an older version wrote."""
        if not self._rows("SELECT 1 FROM sqlite_schema WHERE name = 'devices'", ()):
            return []
        rows = self._rows("SELECT session, from_seq, utc, record FROM devices ORDER BY id", ())
        return [Devices(session, seq, utc, tuple(msgspec.json.decode(record))) for session, seq, utc, record in rows]

    def _rows(self, statement: str, values: tuple[Any, ...]) -> list[Any]:
        with self._lock, explained(self.file):
            if self._connection is None:
                raise StoreError(f"the store {self.file} is closed; use it in a with statement")
            return self._connection.execute(statement, values).fetchall()

    def _close(self) -> None:
        with self._lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None


class PairStore:
    """Writes a pair store, which it makes when there is none.

    Use as a context manager, and append from one thread at a time. A pair that `append` returned is on the disk
    (`synchronous=FULL`). Sequence numbers run from 1 without gaps. Only one process can have a store open for
    writing; its death, whatever its kind, frees it.
    """

    def __init__(self, file: Path, session: Session) -> None:
        self.file = file
        self.reader = PairReader(file)
        self._session = session
        self._lock_file: int | None = None
        self._connection: sqlite3.Connection | None = None
        self._seq = 0
        self._session_id = 0

    @property
    def identity(self) -> str:
        """UUID of the store."""
        return self.reader.identity

    def __enter__(self) -> Self:
        try:
            self._open()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def append(self, segment: int, utc: str, q: FloatArray, fix: MarkerFix) -> Pair:
        """Number a pair and commit it.

        Raises:
            StoreError: the disk is full or broken; the pair is not in the store.
        """
        connection = self._require_open()
        measured = (fix.x, fix.cov, fix.centres_px, fix.R, fix.cov_R)
        pair = Pair(self.identity, self._seq + 1, segment, fix.t, utc, q, *measured)
        with explained(self.file), store_schema.transaction(connection):
            connection.execute(
                f"INSERT INTO pairs (session, {COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (self._session_id, *row_of(pair)),
            )
        self._seq = pair.seq
        return pair

    def note_devices(self, utc: str, record: Sequence[Mapping[str, object]]) -> None:
        """Keep what the joints are read with from the next pair on.

        Raises:
            StoreError: the disk is full or broken.
        """
        connection = self._require_open()
        with explained(self.file), store_schema.transaction(connection):
            # What no pair was measured with tells nothing of the pairs.
            connection.execute("DELETE FROM devices WHERE from_seq > ?", (self._seq,))
            connection.execute(
                "INSERT INTO devices (session, from_seq, utc, record) VALUES (?, ?, ?, ?)",
                (self._session_id, self._seq + 1, utc, as_json(record)),
            )

    def go_on_with(self, session: Session) -> None:
        """What the sampler works with from the next pair on.

        Raises:
            StoreError: the disk is full or broken.
        """
        connection = self._require_open()
        self._session = session
        with explained(self.file):
            self._begin_session(connection)

    def trim(self, keep: Keep, utc: str) -> int:
        """Delete the oldest pairs that are not to be kept, a part of them at a time; how many were deleted.

        Args:
            utc: now.

        Raises:
            StoreError: the disk is full or broken.
        """
        connection = self._require_open()
        with explained(self.file):
            last = keep.last_to_delete(connection, utc)
            if last is None:
                return 0
            with store_schema.transaction(connection):
                return delete_until(connection, last)

    def read(self, from_seq: int = 1, to_seq: int | None = None, limit: int | None = None) -> list[Pair]:
        """As `PairReader.read`; from any thread."""
        return self.reader.read(from_seq, to_seq, limit)

    def last(self) -> Pair | None:
        """As `PairReader.last`; from any thread."""
        return self.reader.last()

    def _open(self) -> None:
        self._make_directory()
        self._lock_file = lock(self.file)
        with explained(self.file):
            self._connection = store_schema.connect(self.file)
            if not self._connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]:
                self._create(self._connection)
            store_schema.check_kind(self._connection, self.file)
            store_schema.check_health(self._connection, self.file)
            store_schema.migrate(self._connection)
            self._check_joints(tuple(msgspec.json.decode(store_schema.meta(self._connection)["joints"])))
            self._connection.execute("PRAGMA journal_mode = WAL")
            self._connection.execute("PRAGMA synchronous = FULL")
            self._begin_session(self._connection)
        self.reader.__enter__()
        self._seq = self.reader.last_seq()

    def _require_open(self) -> sqlite3.Connection:
        if self._connection is None:
            raise StoreError(f"the store {self.file} is closed; use it in a with statement")
        return self._connection

    def _make_directory(self) -> None:
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StoreError(
                f"cannot make the directory {self.file.parent}: {error.strerror}. Give another one with --state-dir, "
                "or as state_dir in the table [daemon] of robot.toml"
            ) from error

    def _create(self, connection: sqlite3.Connection) -> None:
        meta = {"store": str(uuid.uuid4()), "created_utc": self._session.started_utc}
        meta["joints"] = msgspec.json.encode(self._session.joints).decode()
        with store_schema.transaction(connection):
            for statement in store_schema.TABLES:
                connection.execute(statement)
            connection.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
            connection.execute(f"PRAGMA application_id = {store_schema.APPLICATION_ID}")
            connection.execute(f"PRAGMA user_version = {store_schema.SCHEMA_VERSION}")

    def _begin_session(self, connection: sqlite3.Connection) -> None:
        session = self._session
        with store_schema.transaction(connection):
            newest = connection.execute("SELECT coalesce(max(seq), 0) FROM pairs").fetchone()[0]
            connection.execute("DELETE FROM devices WHERE from_seq > ?", (newest,))
            # A sampler that is started again and again without seeing a pair must not fill the disk.
            connection.execute(
                "DELETE FROM sessions WHERE id > coalesce((SELECT session FROM pairs ORDER BY seq DESC LIMIT 1), 0)"
            )
            done = connection.execute(
                "INSERT INTO sessions (started_utc, robot_toml, urdf, config, version, host) VALUES (?, ?, ?, ?, ?, ?)",
                (session.started_utc, session.robot_toml, session.urdf, session.config, session.version, session.host),
            )
        self._session_id = int(done.lastrowid or 0)

    def _check_joints(self, stored: tuple[str, ...]) -> None:
        if stored != self._session.joints:
            raise StoreError(
                f"{self.file} holds pairs of the joints {', '.join(stored)}; robot.toml has "
                f"{', '.join(self._session.joints)}. Give this robot a state_dir of its own (--state-dir), "
                f"or move the file away. {NOTHING_CHANGED}"
            )

    def _close(self) -> None:
        self.reader.__exit__(None, None, None)
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._lock_file is not None:
            os.close(self._lock_file)
            self._lock_file = None
