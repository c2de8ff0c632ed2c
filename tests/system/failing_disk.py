"""A folder whose disk fails on demand, through the preloaded library `disk_shim/shim.c`."""

from __future__ import annotations

import mmap
import os
import shutil
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

HERE = Path(__file__).parent / "disk_shim"
FAULTS = struct.Struct("<2iq")
RECORD = struct.Struct("<2I3Q")


def compiled(folder: Path) -> Path | None:
    """Compile the shim into `folder`; return None if there is no compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    library = folder / "disk_shim.so"
    flags = ["-shared", "-fPIC", "-O1", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([compiler, *flags, HERE / "shim.c", "-o", library, "-ldl", "-lpthread"], check=True)
    return library


class FailingDisk:
    """Faults of the disk of a folder, and of the wall clock of the processes that use it.

    Attributes:
        environment: environment of a process that uses this disk.
        log: file with all operations on the folder.
    """

    def __init__(self, folder: Path, library: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        file, self.log = folder.with_name("faults"), folder.with_name("disk.log")
        file.write_bytes(bytes(FAULTS.size))
        with file.open("r+b") as stream:
            self._faults = mmap.mmap(stream.fileno(), FAULTS.size)
        self._errno, self._slow_ms, self._clock_s = 0, 0, 0
        self.environment = {
            "LD_PRELOAD": str(library),
            "DISK_SHIM_FOLDER": os.path.realpath(folder),
            "DISK_SHIM_LOG": str(self.log),
            "DISK_SHIM_FAULTS": str(file),
        }

    def refuse(self, number: int) -> None:
        """Fail every write with this errno; 0 stops that."""
        self._errno = number
        self._tell()

    def slow(self, milliseconds: int) -> None:
        """Delay every write by this time."""
        self._slow_ms = milliseconds
        self._tell()

    def move_clock(self, seconds: int) -> None:
        """Set the wall clock ahead by this time."""
        self._clock_s = seconds
        self._tell()

    def _tell(self) -> None:
        self._faults[:] = FAULTS.pack(self._errno, self._slow_ms, self._clock_s)


class Operation(IntEnum):
    """Kind of operation on the folder."""

    WRITE = 1
    TRUNCATE = 2
    SYNC = 3
    SYNC_FOLDER = 4
    CREATE = 5
    RENAME = 6
    UNLINK = 7
    LINK = 8


@dataclass(frozen=True, slots=True)
class Done:
    """One operation: on the file `inode`, at `offset`; with names, `name` and in `data` the second one."""

    operation: Operation
    inode: int
    offset: int
    name: str
    data: bytes


def read_log(log: Path) -> Iterator[Done]:
    """Yield all operations in order."""
    notes, at = log.read_bytes(), 0
    while at < len(notes):
        operation, name_size, inode, offset, data_size = RECORD.unpack_from(notes, at)
        named = at + RECORD.size
        data = named + name_size
        at = data + data_size
        yield Done(Operation(operation), inode, offset, notes[named:data].decode(), notes[data:at])
