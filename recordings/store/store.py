"""The pair store: one SQLite file, one transaction for each pair, one writer, any number of readers."""

from __future__ import annotations

import logging
import os
import sqlite3
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice, takewhile
from pathlib import Path
from threading import Lock
from typing import Any, Self

import msgspec
import numpy as np

from bodyschema.interfaces.errors import StoreError, StoreUnwritable
from bodyschema.interfaces.records import FloatArray, MarkerFix, Pair, frozen_array
from bodyschema.recordings.store import schema as store_schema
from bodyschema.recordings.store.damage import Damage, count_pairs, oldest, rebuild, records, scan, scan_back
from bodyschema.recordings.store.file import (
    NOTHING_CHANGED,
    FileIdentities,
    damaged,
    explained,
    file_identities,
    gone,
    is_damage,
    lock,
    unwritable,
)
from bodyschema.recordings.store.retention import AT_ONCE, Keep, delete_until
from bodyschema.recordings.store.rows import Checked, as_json, checked, decoded, pair_of, require_sound, row_of, sealed

# Header of the file and of each frame: magic, version, page size, sequence, two salts, checksum; page, size, salts,
# checksum.
_HEADER, _FRAME = struct.Struct(">6I8x"), struct.Struct(">4I8x")


def commits(store: Path) -> list[bool]:
    """Return a flag for each frame of a store's log: True if it ended a transaction.

    The list ends before the first frame of an older log. A log that is missing or has a damaged header has no frames.
    """
    found: list[bool] = []
    try:
        with store.with_name(f"{store.name}-wal").open("rb") as log:
            header = log.read(_HEADER.size)
            if len(header) < _HEADER.size:
                return []
            _, _, page_bytes, _, *salts = _HEADER.unpack(header)
            while len(frame := log.read(_FRAME.size)) == _FRAME.size:
                _, pages, *own = _FRAME.unpack(frame)
                if own != salts:
                    break
                found.append(pages > 0)
                log.seek(page_bytes, 1)
    except OSError:
        return []
    return found


log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Session:
    """Configuration of one run of the sampler, stored with the pairs so that they can be understood later."""

    # names in the order of q. They hold for the whole store; another order needs another store.
    joints: tuple[str, ...]
    started_utc: str
    # robot_toml, urdf: texts of the two files
    robot_toml: str
    urdf: str
    config: str  # all tables including overrides, as JSON
    version: str
    host: str


@dataclass(frozen=True, slots=True)
class Devices:
    """Devices that read the joints."""

    session: int  # number of the sampler's run
    from_seq: int  # first pair they apply to, until the next entry
    utc: str
    record: tuple[dict[str, Any], ...]  # for each joint: names and settings, as reported by its driver


@dataclass(frozen=True, slots=True)
class Audit:
    """Result of checking each row of a store."""

    pairs: int  # number of sound pairs
    newest: int  # number of the newest pair, sound or not; 0 in an empty store
    session: int  # session of the newest sound pair; 0 in an empty store
    damage: Damage  # numbers of pairs that cannot be read
    lost_rows: int  # number of existing but unreadable rows, of pairs and of related tables
    # smallest and largest joint angles, each shape (d,) [rad or m]; None if there is no pair
    joint_ranges: tuple[FloatArray, FloatArray] | None


class PairReader:
    """Reader of a pair store, also while a sampler writes it. Use as a context manager; any thread may read.

    Rows that the disk corrupted, or that SQLite cannot read, are skipped.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.identity = ""  # UUID of the store
        self.joints: tuple[str, ...] = ()  # names in the order of q
        self.damage = Damage()  # numbers of pairs that could not be read so far
        self._connection: sqlite3.Connection | None = None
        self._columns, self._with_checksums, self._given_up_to = "", True, 0
        self._lock = Lock()

    def __enter__(self) -> Self:
        require_store(self.file)
        with explained(self.file):
            self._connection = store_schema.connect(self.file, readonly=True)
            try:
                store_schema.check_kind(self._connection, self.file)
                schema = store_schema.version(self._connection)
                meta = store_schema.meta(self._connection)
            except ValueError as error:
                self._close()
                what = f"{self.file} is damaged ({error}). Start the sampler: it puts the samples into a new file"
                raise StoreError(what) from error
            except BaseException:
                self._close()
                raise
        self._columns, self._with_checksums = store_schema.columns(schema), schema >= store_schema.WITH_CHECKSUMS
        self.identity, self.joints = meta["store"], store_schema.joints_of(meta)
        self._given_up_to = store_schema.given_up_to(meta)
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def read(self, from_seq: int = 1, to_seq: int | None = None, limit: int | None = None) -> list[Pair]:
        """Return sound pairs `from_seq` to `to_seq` (inclusive; None: the newest) in order, at most `limit` of them.

        Raises:
            StoreError: the file cannot be read.
        """
        with self._reading() as connection:
            found = scan(connection, self._columns, self._pair, from_seq)
            wanted = found if to_seq is None else takewhile(lambda pair: pair.seq <= to_seq, found)
            pairs = list(islice(wanted, limit))
            if pairs and pairs[-1].seq - from_seq >= len(pairs):
                before = [from_seq - 1] if from_seq > oldest(connection) else []
                self.damage |= Damage.between([*before, *(pair.seq for pair in pairs)])
        return pairs

    def last(self) -> Pair | None:
        """Return the newest sound pair, or None."""
        with self._reading() as connection:
            try:
                back = scan_back(connection, self._columns, self._pair)
                return next((pair for pair in back if pair is not None), None)
            except sqlite3.DatabaseError as error:
                if not is_damage(error):
                    raise
            return max(scan(connection, self._columns, self._pair), key=lambda pair: pair.seq, default=None)

    def last_seq(self) -> int:
        """Return the sequence number of the newest pair, sound or not; 0 in an empty store."""
        with self._reading() as connection:
            behind, newest = 0, 0
            try:
                for pair in scan_back(connection, self._columns, self._check):
                    if pair is not None:
                        newest = pair.seq
                        break
                    behind += 1
            except sqlite3.DatabaseError as error:
                if not is_damage(error):
                    raise
                newest = max((pair.seq for pair in scan(connection, self._columns, self._check)), default=0)
            return max(newest + behind, self._given_up_to)

    def first_seq(self) -> int:
        """Return the sequence number of the oldest pair; 1 in an empty store."""
        with self._reading() as connection:
            return oldest(connection)

    def present_damage(self) -> Damage:
        """Return the part of `damage` that has not been deleted with the oldest pairs."""
        return self.damage.since(self.first_seq()) if self.damage.count else self.damage

    def trouble(self) -> str | None:
        """Return the problem with the file's pages, or None."""
        with self._reading() as connection:
            return store_schema.trouble(connection)

    def audit(self, working: Callable[[], None] = lambda: None) -> Audit:
        """Check each row. Unreadable pairs are added to `damage`.

        Raises:
            StoreError: the file cannot be read.
        """
        newest = self.last_seq()
        with self._reading() as connection, store_schema.told_while_working(connection, working):
            numbers: list[int] = []
            session, ends = 0, np.empty((0, len(self.joints)))
            rows = scan(connection, self._columns, self._check)
            while some := list(islice(rows, AT_ONCE)):
                numbers += [pair.seq for pair in some]
                session, angles = some[-1].session, np.vstack([ends, [pair.q for pair in some]])
                ends = np.stack([angles.min(axis=0), angles.max(axis=0)])
            first = oldest(connection)
            before = [first - 1] if numbers and first < numbers[0] else []
            self.damage |= Damage.between([*before, *numbers, newest + 1])
            lost = count_pairs(connection, len(numbers)) - len(numbers)
            lost += sum(row is None for table in ("sessions", "devices") for row in records(connection, table))
        ranges = (frozen_array(ends[0]), frozen_array(ends[1])) if numbers else None
        return Audit(len(numbers), newest, session, self.damage, lost, ranges)

    def devices(self) -> list[Devices]:
        """Return the devices that read the joints, in the order of the pairs; empty in a store of an older version."""
        with self._reading() as connection:
            rows = [row[1:] for row in records(connection, "devices") if row is not None]
        try:
            return [
                Devices(session, seq, utc.decode(), tuple(msgspec.json.decode(record, type=list[dict[str, Any]])))
                for session, seq, utc, record in rows
            ]
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, AttributeError, TypeError) as error:
            raise StoreError(damaged(self.file, f"what the joints were read with is not a record: {error}")) from error

    def _pair(self, row: tuple[Any, ...]) -> Pair:
        if self._with_checksums:
            require_sound(row)
        return pair_of(self.identity, row[:-1], len(self.joints))

    def _check(self, row: tuple[Any, ...]) -> Checked:
        if self._with_checksums:
            require_sound(row)
            return checked(row, len(self.joints))
        return Checked(row[0], row[1], decoded(row[:-1], len(self.joints))[5])

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with self._lock, explained(self.file):
            if self._connection is None:
                raise StoreError(f"the store {self.file} is closed; use it in a with statement")
            yield self._connection

    def _close(self) -> None:
        with self._lock:
            if self._connection is not None:
                self._connection.close()
                self._connection = None


class PairStore:
    """Writer of a pair store, which is created if it does not exist.

    Use as a context manager, and append from one thread at a time. A pair returned by `append` is on the disk
    (`synchronous=FULL`). Sequence numbers run from 1 without gaps. Only one process can have a store open for writing;
    the end of the process, of any kind, releases it.
    """

    def __init__(self, file: Path, session: Session, *, working: Callable[[], None] = lambda: None) -> None:
        """Store the settings; nothing is opened yet.

        Args:
            working: called repeatedly while the store is opened, which takes longer the more pairs it has.
        """
        self.file = file
        self.reader = PairReader(file)
        self._session, self._working = session, working
        self._lock_file: int | None = None
        self._connection: sqlite3.Connection | None = None
        self._seq = 0
        self._session_id = self._newest_session = 0
        self._audit: Audit | None = None
        self._rebuilt: str | None = None
        self._identities: FileIdentities = (None, None)

    @property
    def identity(self) -> str:
        return self.reader.identity

    @property
    def audit(self) -> Audit:
        """Result of checking each row when the store was opened."""
        if self._audit is None:
            raise StoreError(f"the store {self.file} is closed; use it in a with statement")
        return self._audit

    @property
    def complaints(self) -> list[str]:
        """Problems with the file, in sentences; from any thread."""
        messages = [] if self._rebuilt is None else [self._rebuilt]
        damage = self.reader.present_damage()
        return [*messages, damage.sentence(self.file)] if damage.count else messages

    def __enter__(self) -> Self:
        try:
            self._open()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def append(self, segment: int, utc: str, q: FloatArray, fix: MarkerFix) -> Pair:
        """Assign the next number to a pair and commit it.

        Raises:
            StoreError: the disk is full or broken, or the file is gone; the pair is not in the store.
        """
        connection = self._require_open()
        self._require_in_place()
        measured = (fix.x, fix.cov, fix.centres_px, fix.R, fix.cov_R)
        pair = Pair(self.identity, self._seq + 1, segment, fix.t, utc, q, *measured)
        with explained(self.file), store_schema.transaction(connection):
            connection.execute(store_schema.INSERT["pairs"], sealed(row_of(pair, self._session_id)))
        self._seq, self._newest_session = pair.seq, self._session_id
        return pair

    def note_devices(self, utc: str, record: Sequence[Mapping[str, object]]) -> None:
        """Store the encoders that the joints are read with from the next pair on.

        Raises:
            StoreError: the disk is full or broken.
        """
        connection = self._require_open()
        with explained(self.file), store_schema.transaction(connection):
            # An entry without pairs carries no information.
            connection.execute("DELETE FROM devices WHERE from_seq > ?", (self._seq,))
            number = connection.execute("SELECT coalesce(max(id), 0) + 1 FROM devices").fetchone()[0]
            row = (number, self._session_id, self._seq + 1, utc, as_json(record))
            connection.execute(store_schema.INSERT["devices"], sealed(row))

    def switch_session(self, session: Session) -> None:
        """Use this session from the next pair on; raise StoreError if the disk is full or broken."""
        connection = self._require_open()
        self._session = session
        with explained(self.file):
            self._begin_session(connection)

    def trim(self, keep: Keep, utc: str) -> int:
        """Delete a batch of the oldest pairs that are no longer kept; return the number deleted.

        Raises:
            StoreError: the disk is full or broken.
        """
        connection = self._require_open()
        with explained(self.file):
            last = keep.last_to_delete(connection, utc, self._seq)
            if last is None:
                return 0
            with store_schema.transaction(connection):
                return delete_until(connection, last)

    def read(self, from_seq: int = 1, to_seq: int | None = None, limit: int | None = None) -> list[Pair]:
        """Read like `PairReader.read`; from any thread."""
        return self.reader.read(from_seq, to_seq, limit)

    def last(self) -> Pair | None:
        """Return the newest pair like `PairReader.last`; from any thread."""
        return self.reader.last()

    def _open(self) -> None:
        self._make_directory()
        self._lock_file = lock(self.file)
        written = commits(self.file)
        with explained(self.file):
            self._connection = store_schema.connect(self.file)
            if not self._connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]:
                store_schema.create(self._connection, self._fresh())
            store_schema.check_kind(self._connection, self.file)
            with store_schema.told_while_working(self._connection, self._working):
                what = store_schema.trouble(self._connection)
            if what is not None:
                self._rebuild(what)
            with store_schema.told_while_working(self._connection, self._working):
                if what is None:
                    self._give_up(self._connection, written)
                store_schema.migrate(self._connection)
            self._check_joints(store_schema.joints_of(store_schema.meta(self._connection)))
            self._connection.execute("PRAGMA journal_mode = WAL")
            self._connection.execute("PRAGMA synchronous = FULL")
            self.reader.__enter__()
            self._audit = self.reader.audit(self._working)
            self._seq, self._newest_session = self._audit.newest, self._audit.session
            self._begin_session(self._connection)
        self._identities = file_identities(self.file)
        for said in self.complaints:
            log.error("%s", said)

    def _require_in_place(self) -> None:
        """Raise StoreUnwritable if the file was deleted, moved or replaced: SQLite would keep writing to the old."""
        now = file_identities(self.file)
        if any(before not in (None, here) for before, here in zip(self._identities, now, strict=True)):
            raise StoreUnwritable(gone(self.file))
        self._identities = now

    def _give_up(self, connection: sqlite3.Connection, written: Sequence[bool]) -> None:
        """Never reuse the numbers of pairs that were committed after a damaged place in the log.

        A single missing pair was torn by a power failure, and had not been accepted.
        """
        if not any(written):
            return
        read = connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()[1]
        lost = sum(written[read:])
        if read >= 0 and lost > 1:
            contents = store_schema.meta(connection)
            newest = connection.execute("SELECT coalesce(max(seq), 0) FROM pairs").fetchone()[0]
            used_up_to = max(newest + lost, store_schema.given_up_to(contents))
            with store_schema.transaction(connection):
                store_schema.write_meta(connection, {**contents, store_schema.GIVEN_UP_TO: str(used_up_to)})

    def _rebuild(self, what: str) -> None:
        """Continue with a new file that contains everything readable."""
        self._require_open().close()
        try:
            kept = rebuild(self.file, self._fresh(), self._working)
        except OSError as error:
            raise StoreUnwritable(unwritable(self.file, error.errno, error.strerror)) from error
        self._connection = store_schema.connect(self.file)
        self._rebuilt = (
            f"{self.file} was damaged ({what}). What could be read was put into a new file, and the damaged one was "
            f"kept as {kept}. Check the disk"
        )

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

    def _fresh(self) -> dict[str, str]:
        return store_schema.new_meta(self._session.joints, self._session.started_utc)

    def _begin_session(self, connection: sqlite3.Connection) -> None:
        session = self._session
        with store_schema.transaction(connection):
            connection.execute("DELETE FROM devices WHERE from_seq > ?", (self._seq,))
            # Repeated restarts of a sampler that sees no pair must not fill the disk.
            connection.execute("DELETE FROM sessions WHERE id > ?", (self._newest_session,))
            number = connection.execute("SELECT coalesce(max(id), 0) + 1 FROM sessions").fetchone()[0]
            contents = (session.started_utc, session.robot_toml, session.urdf, session.config, session.version)
            connection.execute(store_schema.INSERT["sessions"], sealed((number, *contents, session.host)))
        self._session_id = number

    def _check_joints(self, stored: tuple[str, ...]) -> None:
        if stored != self._session.joints:
            raise StoreError(
                f"{self.file} holds samples of the joints {', '.join(stored)}; robot.toml has "
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


def require_store(file: Path) -> None:
    """Raise StoreError if the path does not exist. Anything but a file is refused when it is opened."""
    if not file.exists():
        raise StoreError(f"there is no store {file}. The sampler makes it: start it with `bodyschema run sampler`")


def leave_out_damage(file: Path, joints: Sequence[str]) -> Audit:
    """Rebuild a store that is not in use if part of it cannot be read; return its contents afterwards.

    Args:
        joints: joint names for a store that lost its own.

    Raises:
        StoreError: the file is not a pair store, or nothing can be read.
    """
    with explained(file):
        with closing(store_schema.connect(file)) as connection:
            store_schema.check_kind(connection, file)
            what = store_schema.trouble(connection)
        if what is None:
            with PairReader(file) as reader:
                audit = reader.audit()
            if not audit.lost_rows:
                return audit
        rebuild(file, store_schema.new_meta(joints, "")).unlink()
    with PairReader(file) as reader:
        return reader.audit()
