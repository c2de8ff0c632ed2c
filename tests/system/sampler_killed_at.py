"""Runs `bodyschema sampler` and kills it, as by SIGKILL from outside, at a statement of a pair's way.

python sampler_killed_at.py POINT NTH --robot robot.toml
"""

from __future__ import annotations

import os
import signal
import sqlite3
import sys
from collections.abc import Callable
from typing import Any

from daemon.bus import Bus
from daemon.cli import main


class Countdown:
    """Kills the process when it was called so many times."""

    def __init__(self, count: int) -> None:
        self._left = count

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
        inserted = statement.startswith("INSERT INTO pairs")

    def traced(*args: Any, **kwargs: Any) -> sqlite3.Connection:
        connection = connect(*args, **kwargs)
        connection.set_trace_callback(trace)
        return connection

    sqlite3.connect = traced


def at_the_publication(kill: Countdown, *, before: bool) -> None:
    """Die before or after a pair is handed to zenoh."""
    declare = Bus.publisher

    def publisher(bus: Bus, key: str, *, cache: int = 0) -> Callable[[bytes], None]:
        publish = declare(bus, key, cache=cache)

        def doomed(payload: bytes) -> None:
            if before:
                kill()
            publish(payload)
            if not before:
                kill()

        return doomed if key.endswith("/pair") else publish

    Bus.publisher = publisher


POINTS: dict[str, Callable[[Countdown], None]] = {
    "at the commit": at_the_commit,
    "before the publication": lambda kill: at_the_publication(kill, before=True),
    "after the publication": lambda kill: at_the_publication(kill, before=False),
}

if __name__ == "__main__":
    POINTS[sys.argv[1]](Countdown(int(sys.argv[2])))
    sys.argv[:] = ["bodyschema", "sampler", *sys.argv[3:]]
    main()
