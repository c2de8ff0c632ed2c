"""Run `bodyschema` and kill it, as by SIGKILL from outside, at a named point of its work.

python killed_at.py POINT NTH JOURNAL sampler --robot robot.toml

The sequence number of each accepted pair is written to JOURNAL, one per line.
"""

from __future__ import annotations

import os
import signal
import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bodyschema.cli.main import main
from bodyschema.daemon.learner import checkpoint
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.recordings.store.store import PairStore

NOWHERE = "at a random moment"  # from outside


class Countdown:
    """Counter that kills the process at its nth call."""

    def __init__(self, nth: int) -> None:
        self._left = nth

    @property
    def last(self) -> bool:
        """True if the next call kills."""
        return self._left == 1

    def __call__(self) -> None:
        self._left -= 1
        if self._left == 0:
            os.kill(os.getpid(), signal.SIGKILL)


def at_the_commit(kill: Countdown) -> None:
    """Die when SQLite is about to run the COMMIT of a pair's transaction."""
    connect = sqlite3.connect
    inserted = False

    def trace(statement: str) -> None:
        nonlocal inserted
        if inserted and statement == "COMMIT":
            kill()
        inserted = statement.startswith("INSERT") and " INTO pairs " in statement

    def traced(*args: Any, **kwargs: Any) -> sqlite3.Connection:
        connection = connect(*args, **kwargs)
        connection.set_trace_callback(trace)
        return connection

    sqlite3.connect = traced


def at_the_publication(kill: Countdown, *, before: bool) -> None:
    """Die before or after a stored pair is handed to zenoh."""
    declare = ZenohSession.publisher

    def publisher(bus: ZenohSession, key: str, *, cache: int = 0) -> Callable[[bytes], None]:
        publish = declare(bus, key, cache=cache)

        def doomed(payload: bytes) -> None:
            if before:
                kill()
            publish(payload)
            if not before:
                kill()

        return doomed if key.endswith("/pair") else publish

    ZenohSession.publisher = publisher


def in_the_middle_of_a_checkpoint(kill: Countdown) -> None:
    """Die when half of a checkpoint is on the disk."""
    write = checkpoint._write_through

    def half(file: Path, data: bytes) -> None:
        write(file, data[: len(data) // 2] if kill.last else data)
        kill()

    checkpoint._write_through = half


def at_the_rename(kill: Countdown, *, before: bool) -> None:
    """Die before or after a complete checkpoint replaces the old one."""
    replace = os.replace

    def doomed(source: Path, target: Path) -> None:
        ours = Path(target).suffix == ".ckpt"
        if ours and before:
            kill()
        replace(source, target)
        if ours and not before:
            kill()

    os.replace = doomed


SAMPLER_POINTS: dict[str, Callable[[Countdown], None]] = {
    "at the commit": at_the_commit,
    "before the publication": lambda kill: at_the_publication(kill, before=True),
    "after the publication": lambda kill: at_the_publication(kill, before=False),
}
LEARNER_POINTS: dict[str, Callable[[Countdown], None]] = {
    "in the middle of a checkpoint": in_the_middle_of_a_checkpoint,
    "before the checkpoint's rename": lambda kill: at_the_rename(kill, before=True),
    "after the checkpoint's rename": lambda kill: at_the_rename(kill, before=False),
}


def keep_journal(file: Path) -> None:
    """Write down each number that the store gave for good; a line that was written survives the process."""
    append = PairStore.append
    journal = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    def noted(store: PairStore, *args: Any) -> Any:
        pair = append(store, *args)
        os.write(journal, f"{pair.seq}\n".encode())
        return pair

    PairStore.append = noted


if __name__ == "__main__":
    point, nth, journal_file = sys.argv[1:4]
    keep_journal(Path(journal_file))
    if point != NOWHERE:
        (SAMPLER_POINTS | LEARNER_POINTS)[point](Countdown(int(nth)))
    sys.argv[:] = ["bodyschema", *sys.argv[4:]]
    main()
