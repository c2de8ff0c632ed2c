"""Log of servo EEPROM writes, one line of JSON each, for undo."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Literal

import msgspec

from bodyschema.interfaces.errors import BodyschemaError, ConfigError
from bodyschema.robot.limited import read_at_most

FILE = "servo_writes.jsonl"
State = Literal["begun", "written", "not written", "something else stands there", "not known"]


class LoggedWrite(msgspec.Struct, frozen=True, kw_only=True):
    """One written value."""

    utc: str
    batch: int  # number shared by all writes of one command
    table: str  # the servo's vendor
    port: str
    # baud, id: baud rate and ID of the servo before the write
    baud: int
    id: int
    model: str
    joint: str
    # name, address: name and address of the register
    name: str
    address: int
    # old, new: its contents before, and the value to write
    old: int
    new: int
    state: State = "begun"  # "begun" is logged before the servo is written, so that the log knows every write
    undoes: int | None = None  # the batch that this one undoes


class ServoLog:
    """The log in a state directory; a missing file counts as empty."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / FILE

    def append(self, entries: Sequence[LoggedWrite]) -> None:
        """Append lines; they are on disk when this returns.

        Raises:
            ConfigError: the file cannot be written.
        """
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            with self.file.open("ab") as stream:
                stream.write(b"".join(msgspec.json.encode(entry) + b"\n" for entry in entries))
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            what = f"what is written to servos cannot be logged: {error.strerror}"
            raise ConfigError(what, file=self.file, remedy="Make room, or set state_dir in [daemon]") from error

    def batches(self) -> dict[int, list[LoggedWrite]]:
        """Return the writes of each command by batch number, each write in its last state.

        Raises:
            BodyschemaError: a line is not an entry, except a last one that a crash cut short.
        """
        if not self.file.exists():
            return {}
        last: dict[tuple[int, str, int, int], LoggedWrite] = {}
        lines = read_at_most(self.file).split(b"\n")
        for number, line in enumerate(lines, 1):
            try:
                entry = msgspec.json.decode(line, type=LoggedWrite) if line else None
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                if number == len(lines):
                    break
                raise BodyschemaError(f"{self.file}, line {number}: {error}. Move the file away") from error
            if entry is not None:
                last[entry.batch, entry.port, entry.id, entry.address] = entry
        ordered = sorted(last.values(), key=lambda entry: entry.batch)
        return {batch: list(entries) for batch, entries in groupby(ordered, key=lambda entry: entry.batch)}

    def to_undo(self) -> list[LoggedWrite]:
        """Return the newest batch that changed something and was not undone; may be empty."""
        batches = self.batches()
        undone = {entries[0].undoes for entries in batches.values() if any(e.state == "written" for e in entries)}
        for number in sorted(batches, reverse=True):
            entries = [entry for entry in batches[number] if entry.state != "not written"]
            if entries and number not in undone and entries[0].undoes is None:
                return entries
        return []
