"""The file of a pair store: one writer, and errors with a remedy."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bodyschema.interfaces.errors import StoreError, StoreUnwritable

FileIdentities = tuple[tuple[int, int] | None, tuple[int, int] | None]
NOTHING_CHANGED = "Nothing was changed"
# SQLite's errors when the disk temporarily accepts no data.
_PASSING = ("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_BUSY")


@contextmanager
def explained(file: Path) -> Iterator[None]:
    """Convert SQLite's errors into StoreErrors that name the file and the remedy."""
    try:
        yield
    except sqlite3.Error as error:
        kind = StoreUnwritable if _name(error).startswith(_PASSING) else StoreError
        raise kind(explanation(file, error)) from error
    except UnicodeDecodeError as error:  # SQLite's message quotes a damaged definition of a table
        raise StoreError(damaged(file, f"a table's definition is not UTF-8: {error}")) from error


def explanation(file: Path, error: sqlite3.Error) -> str:
    name = _name(error)
    if name == "SQLITE_FULL" or (name.startswith("SQLITE_IOERR") and free_bytes(file) < 2**16):
        return unwritable(file, errno.ENOSPC, "")
    if name.startswith(("SQLITE_READONLY", "SQLITE_CANTOPEN")):
        return unwritable(file, errno.EROFS, str(error))
    if name.startswith("SQLITE_NOTADB"):
        return f"{file} is not a sample store. Move it away, or give another --state-dir. {NOTHING_CHANGED}"
    if is_damage(error):
        return damaged(file, str(error))
    return f"{file}: {error} ({name or type(error).__name__}). Check the disk"


def is_damage(error: sqlite3.Error) -> bool:
    """Return True if SQLite found the file corrupted."""
    return _name(error).startswith(("SQLITE_CORRUPT", "SQLITE_TOOBIG")) or isinstance(error, sqlite3.DataError)


def _name(error: sqlite3.Error) -> str:
    return getattr(error, "sqlite_errorname", "")


def unwritable(file: Path, number: int | None, what: str | None) -> str:
    if number == errno.ENOSPC:
        return f"the disk of {file} is full. Free some space, or give a --state-dir on another disk. {NOTHING_CHANGED}"
    why = "the disk is read-only" if number == errno.EROFS else what
    return f"cannot write {file}: {why}. Give a --state-dir that can be written"


def damaged(file: Path, what: str) -> str:
    return (
        f"{file} is damaged ({what}). Restore a backup (`bodyschema backup FILE --restore --force` keeps this one), or "
        f"keep it and give another --state-dir; `sqlite3 {file.name} .recover` shows what can be read. "
        f"{NOTHING_CHANGED}"
    )


def gone(file: Path) -> str:
    return (
        f"{file} was deleted, moved or replaced while the sampler had it open. "
        "Put it back, or start the sampler again, which takes what is there"
    )


def file_identities(file: Path) -> FileIdentities:
    """Return device and inode of a store and of its write-ahead log; None for a missing file."""
    found: list[tuple[int, int] | None] = []
    for part in (file, file.with_name(f"{file.name}-wal")):
        try:
            state = os.stat(part)
            found.append((state.st_dev, state.st_ino))
        except OSError:
            found.append(None)
    return found[0], found[1]


def free_bytes(file: Path) -> int:
    return shutil.disk_usage(file.parent).free


LOW_DISK_BYTES = 200 * 2**20  # below this the sampler warns, and the doctor


def disk_free(file: Path) -> int:
    """Return the free bytes on the store's disk; raise StoreError if its folder is gone."""
    try:
        return free_bytes(file)
    except OSError as error:
        raise StoreError(f"the directory of {file} is gone: {error.strerror}") from error


def lock(file: Path, writer: str = "sampler") -> int:
    """Lock a file next to `file`; the process's end releases the lock, and children do not inherit it.

    Raises:
        StoreUnwritable: the disk cannot hold the lock file.
        StoreError: another process has locked it.
    """
    lock_file = file.with_name(file.name + ".lock")
    try:
        descriptor = os.open(lock_file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise StoreUnwritable(unwritable(file, error.errno, error.strerror)) from error
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        raise StoreError(
            f"another {writer} is writing {file}. Stop it (`bodyschema status` shows it), "
            "or give this one a --state-dir of its own"
        ) from error
    return descriptor
