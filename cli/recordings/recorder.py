"""Copy the running sampler's pairs into a file: first its history, then new ones."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import TextIO

from bodyschema.cli.recordings.rerun_scene import scene_for
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.wire import PairsReply, decode, pair_from_wire
from bodyschema.interfaces.errors import BusError, RecordingError
from bodyschema.interfaces.records import Pair
from bodyschema.interfaces.whole_files import raising_write_errors
from bodyschema.recordings import files as recordings
from bodyschema.recordings.csv_file import write_csv_rows
from bodyschema.recordings.parquet_file import INTEGER_COLUMNS
from bodyschema.recordings.recording import CSV, Recording
from bodyschema.recordings.store.damage import Damage
from bodyschema.robot.description import RobotDescription

log = logging.getLogger(__name__)


class History:
    """The sampler's stored pairs from a sequence number on, page by page. Publications only trigger a request."""

    def __init__(self, bus: ZenohSession, robot: RobotDescription, from_seq: int) -> None:
        self._bus, self._joints, self._keys = bus, robot.joints, Keys(robot.name)
        self._news = Event()
        self._store: str | None = None
        self.next_seq = from_seq  # sequence number of the next pair
        self.missing = Damage()  # numbers between the pairs so far that the sampler does not have
        self._begun = False
        bus.subscribe(self._keys.pair, lambda _: self._news.set())

    def page(self) -> list[Pair]:
        """Return the next pairs, at most one reply; an empty list if there are no more for now.

        Raises:
            BusError: the sampler does not answer.
            RecordingError: it now writes another store, whose numbers belong to other pairs.
        """
        self._news.clear()
        reply = decode(self._bus.ask_one(f"{self._keys.pairs}?from={self.next_seq}"), PairsReply)
        if self._store not in (None, reply.store):
            raise RecordingError(
                f"the sampler writes another store now ({reply.store})",
                file=self._store,
                remedy="Record it into another file",
            )
        self._store = reply.store
        pairs = [pair_from_wire(message, len(self._joints)) for message in reply.pairs]
        if pairs:
            before = [self.next_seq - 1] if self._begun else []
            self.missing |= Damage.between([*before, *(pair.seq for pair in pairs)])
            self.next_seq, self._begun = pairs[-1].seq + 1, True
        return pairs

    def wait(self, longest_s: float = 0.5) -> None:
        """Wait for a published pair, or for a moment."""
        self._news.wait(longest_s)


def copy_history(history: History, robot: RobotDescription, out: Path) -> int:
    """Write all existing pairs into `out`; return their number.

    Raises:
        RecordingError: there are none, or `out` cannot be written.
        BusError: the sampler does not answer.
    """
    pairs: list[Pair] = []
    while page := history.page():
        pairs += page
    if not pairs:
        raise RecordingError(
            f"the sampler has no samples from number {history.next_seq} on",
            file=out,
            remedy="Move the arm in front of the camera, or wait for samples with --follow",
        )
    _write(recordings.from_pairs(pairs, robot.joints), out, robot)
    return len(pairs)


def _write(recording: Recording, out: Path, robot: RobotDescription) -> None:
    recordings.write(recording, out, scene=scene_for(out, robot.file, recording))


def follow_history(history: History, robot: RobotDescription, out: Path, stopped: Callable[[], bool]) -> int:
    """Write pairs into `out` as they arrive until `stopped`; return their number.

    CSV is written line by line, so that all rows survive an abrupt end. The other formats are only complete with their
    last byte and are written at the end. If the sampler goes away, wait for it.

    Raises:
        RecordingError: `out` cannot be written, or the sampler came back with another store.
    """
    if out.suffix.lower() != CSV:
        pairs: list[Pair] = []
        _follow(history, stopped, pairs.extend)
        if pairs:
            _write(recordings.from_pairs(pairs, robot.joints), out, robot)
        return len(pairs)
    with raising_write_errors(out, RecordingError), out.open("w", encoding="utf-8", newline="\n") as stream:
        rows = _CsvRows(stream, robot.joints)
        _follow(history, stopped, rows.add)
    if not rows.count:
        out.unlink()
    return rows.count


def _follow(history: History, stopped: Callable[[], bool], take: Callable[[list[Pair]], object]) -> None:
    answering = True
    while not stopped():
        try:
            page = history.page()
        except BusError as error:
            if answering:
                log.warning("%s. Waiting for it", error)
            page, answering = [], False
        else:
            answering = True
        if page:
            take(page)
        else:
            history.wait()


class _CsvRows:
    def __init__(self, stream: TextIO, joints: tuple[str, ...]) -> None:
        self._stream, self._joints = stream, joints
        self._names: tuple[str, ...] = ()
        self.count = 0

    def add(self, pairs: list[Pair]) -> None:
        table = recordings.from_pairs(pairs, self._joints).to_table()
        if not self._names:
            self._names = table.names
            self._stream.write(",".join(table.names) + "\n")
        if table.names != self._names:
            raise RecordingError(
                f"from sample {pairs[0].seq} to {pairs[-1].seq} some have a marker orientation and some do not",
                file=Path(self._stream.name),
                remedy=f"The {self.count} rows so far are whole; record what follows into another file",
            )
        integers = frozenset(i for i, name in enumerate(table.names) if name in INTEGER_COLUMNS)
        write_csv_rows(self._stream, table.values.tolist(), integers)
        self._stream.flush()
        self.count += len(pairs)
