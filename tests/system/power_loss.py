"""Contents of a disk after a power loss: all that was synced, and a random part of the rest.

Each sector of a write that was not synced is there or not, independently of the others. Of name changes (create,
rename, remove) that were not synced, a random number of the first is there: file systems write them in order.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from failing_disk import Done, Operation

SECTOR = 512


def _overlay(content: bytearray, offset: int, data: bytes) -> None:
    if len(content) < offset:
        content.extend(bytes(offset - len(content)))
    content[offset : offset + len(data)] = data


def _cut(content: bytearray, size: int) -> None:
    del content[size:]
    content.extend(bytes(size - len(content)))


class File:
    """A file: its contents as read now, its contents on the disk, and the pending operations."""

    def __init__(self) -> None:
        self.present, self._safe = bytearray(), bytearray()
        self._pending: list[Done] = []

    def change(self, done: Done) -> None:
        """Write or truncate it."""
        self._pending.append(done)
        if done.operation is Operation.WRITE:
            _overlay(self.present, done.offset, done.data)
        else:
            _cut(self.present, done.offset)

    def sync(self) -> None:
        """Mark all operations as being on the disk."""
        self._safe = bytearray(self.present) if self._pending else self._safe
        self._pending.clear()

    def after_power_loss(self, rng: np.random.Generator) -> bytes:
        """Return the contents that the disk has after a power loss."""
        left, share = bytearray(self._safe), rng.random()
        for done in self._pending:
            if done.operation is Operation.TRUNCATE:
                if rng.random() < share:
                    _cut(left, done.offset)
                continue
            at = 0
            while at < len(done.data):
                size = min(SECTOR - (done.offset + at) % SECTOR, len(done.data) - at)
                if rng.random() < share:
                    _overlay(left, done.offset + at, done.data[at : at + size])
                at += size
        return bytes(left)


Names = dict[str, File]


class Disk:
    """A folder on a disk whose power may fail.

    Attributes:
        names: the files by their present names.
    """

    def __init__(self) -> None:
        self.names: Names = {}
        self._safe: Names = {}
        self._pending: list[tuple[Done, File | None]] = []
        self._files: dict[int, File] = {}

    def do(self, done: Done) -> None:
        """Do to it what a process did."""
        match done.operation:
            case Operation.WRITE | Operation.TRUNCATE:
                self._files[done.inode].change(done)
            case Operation.SYNC:
                self._files[done.inode].sync()
            case Operation.SYNC_FOLDER:
                self._safe = dict(self.names)
                self._pending.clear()
            case _:
                made = None
                if done.operation is Operation.CREATE:
                    made = self._files[done.inode] = File()
                self._pending.append((done, made))
                _rename(self.names, done, made)

    def after_power_loss(self, rng: np.random.Generator, folder: Path) -> None:
        """Write what the disk has into an empty folder."""
        names = dict(self._safe)
        for done, made in self._pending[: rng.integers(len(self._pending) + 1)]:
            _rename(names, done, made)
        for name, file in names.items():
            (folder / name).write_bytes(file.after_power_loss(rng))


def _rename(names: Names, done: Done, made: File | None) -> None:
    second = done.data.decode()
    match done.operation:
        case Operation.CREATE if made is not None:
            names[done.name] = made
        case Operation.RENAME:
            names[second] = names.pop(done.name)
        case Operation.LINK:
            names[second] = names[done.name]
        case _:
            del names[done.name]
