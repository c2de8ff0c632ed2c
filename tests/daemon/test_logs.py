from __future__ import annotations

import faulthandler
import io
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from bodyschema.daemon.sampler import pair_writer
from bodyschema.daemon.sampler.pair_writer import ResilientWriter
from bodyschema.daemon.service import logs
from bodyschema.daemon.service.signals import on_termination
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import StoreUnwritable
from bodyschema.interfaces.records import MarkerFix
from bodyschema.recordings.store.store import PairStore


@pytest.fixture(autouse=True)
def root_logger() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:], root.level = handlers, level
    for name in logs._FLOODED:
        flooded = logging.getLogger(name)
        flooded.handlers[:], flooded.propagate = [], True


def logged(file: Path, environment: Callable[[os.stat_result], dict[str, str]]) -> list[str]:
    """Return the lines of a log whose stream is a file, as the journal's is a socket."""
    with file.open("w") as stream:
        logs.set_up(environment=environment(os.fstat(stream.fileno())), stream=stream)
        log = logging.getLogger("bodyschema.daemon.sampler.sampler")
        log.warning("the disk\nis nearly full")
        log.info("all is well")
        log.debug("details")
        faulthandler.disable()
    return file.read_text().splitlines()


def of_journal(status: os.stat_result) -> dict[str, str]:
    return {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}


def test_journal_gets_one_prioritised_line_per_event(tmp_path) -> None:
    assert logged(tmp_path / "log", of_journal) == [
        "<4>bodyschema.daemon.sampler.sampler: the disk | is nearly full",
        "<6>bodyschema.daemon.sampler.sampler: all is well",
    ]


@pytest.mark.parametrize("inherited", [{}, {"JOURNAL_STREAM": "8:1"}])
def test_terminal_log_has_time_despite_inherited_journal_stream(tmp_path, inherited) -> None:
    assert logged(tmp_path / "log", lambda _: inherited)[-1].endswith(
        "INFO    bodyschema.daemon.sampler.sampler: all is well"
    )


def test_malformed_requests_fill_no_terminal(tmp_path) -> None:
    stream = io.StringIO()
    logs.set_up(environment={}, stream=stream)
    for _ in range(50):
        logging.getLogger("uvicorn.error").warning("Invalid HTTP request received.")
        logging.getLogger("bodyschema").warning("ours")
    logging.getLogger("uvicorn").handlers[0].close()
    lines = [line.split(": ", 1)[1] for line in stream.getvalue().splitlines()]
    assert lines.count("ours") == 50
    first, again = (line for line in lines if line != "ours")
    assert (first, again[:13]) == ("Invalid HTTP request received.", "49 more times")


def test_intermittently_full_disk_does_not_flood_log() -> None:
    stream, said = io.StringIO(), [StoreUnwritable("the disk is full"), 1] * 50
    logs.set_up(environment={}, stream=stream)
    writer = ResilientWriter(cast(PairStore, Flapping(said)), SystemClock())
    for _ in range(100):
        writer.append(1, np.zeros(2), cast(MarkerFix, None))
    lines = [line.split(": ", 1)[1] for line in stream.getvalue().splitlines()]
    assert lines == ["the disk is full; it is tried again with each sample", "the disk takes samples again"]
    logging.getLogger(pair_writer.__name__).handlers[0].close()
    assert "49 more times" in stream.getvalue()


class Flapping:
    """A store on a disk that is full for every second pair."""

    file = Path("pairs.sqlite")

    def __init__(self, said: list[Exception | int]) -> None:
        self._recent = iter(said)

    def append(self, *_: object) -> int:
        found = next(self._recent)
        if isinstance(found, Exception):
            raise found
        return found


class HandClock:
    """A clock that is moved by hand."""

    time = 0.0

    def __call__(self) -> float:
        return self.time


class Journal:
    """A journal's handler with its lines."""

    def __init__(self) -> None:
        self._stream, self.now = io.StringIO(), HandClock()
        self.handler = logs.UnrepeatedHandler(self._stream, logs.JournalFormatter("%(name)s: %(message)s"), self.now)

    def say(self, text: str, level: int = logging.WARNING) -> None:
        self.handler.handle(logging.LogRecord("bus", level, "", 0, text, None, None))

    @property
    def lines(self) -> list[str]:
        return self._stream.getvalue().splitlines()


def test_an_error_is_one_line_with_its_traceback() -> None:
    journal = Journal()
    try:
        raise ValueError("too far")
    except ValueError:
        record = logging.LogRecord("bus", logging.ERROR, "", 0, "a query failed", None, sys.exc_info())
    journal.handler.handle(record)
    assert len(journal.lines) == 1
    assert journal.lines[0].startswith("<3>bus: a query failed | Traceback")
    assert journal.lines[0].endswith("| ValueError: too far")


def test_repeated_message_is_summarised_after_a_minute() -> None:
    journal = Journal()
    for _ in range(100):
        journal.say("no answer")
    journal.now.time = 61.0
    journal.say("all is well")
    assert journal.lines == ["<4>bus: no answer", "<4>bus: 99 more times in 61 s: no answer", "<4>bus: all is well"]


def test_message_is_logged_again_after_a_minute() -> None:
    journal = Journal()
    journal.say("no answer")
    journal.now.time = 61.0
    journal.say("no answer")
    assert journal.lines == ["<4>bus: no answer"] * 2


def test_flood_differing_only_in_numbers_is_cut_off() -> None:
    journal = Journal()
    for number in range(500):
        journal.say(f"sample {number} was refused")
    journal.handler.close()
    assert journal.lines[:2] == ["<4>bus: sample 0 was refused", "<4>bus: sample 1 was refused"]
    assert len(journal.lines) == logs.RepeatSettings.often + 1
    assert journal.lines[-1] == f"<4>bus: {500 - logs.RepeatSettings.often} more times in 0 s: sample # was refused"


def test_same_warning_for_two_joints_names_both() -> None:
    journal = Journal()
    for joint in (3, 4, 3, 4):
        journal.say(f"joint {joint} is hot")
    assert journal.lines == ["<4>bus: joint 3 is hot", "<4>bus: joint 4 is hot"]


def test_error_is_not_suppressed_by_identical_warning() -> None:
    journal = Journal()
    for level in (logging.WARNING, logging.ERROR):
        journal.say("the bus is silent", level)
    assert journal.lines == ["<4>bus: the bus is silent", "<3>bus: the bus is silent"]


def test_number_of_remembered_messages_is_bounded() -> None:
    journal = Journal()
    for k in range(5000):
        journal.say("x" * (k % 1000))
    assert len(journal.handler._recent) <= logs.RepeatSettings.remembered


def test_a_signal_calls_for_an_orderly_end() -> None:
    called = []
    with on_termination(lambda: called.append("stop")):
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
    assert called == ["stop", "stop"]


def test_signals_are_handled_as_before_afterwards() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with on_termination(lambda: None):
        pass
    assert signal.getsignal(signal.SIGTERM) is before


def test_sighup_triggers_reload() -> None:
    called, before = [], signal.getsignal(signal.SIGHUP)
    with on_termination(lambda: called.append("stop"), reload=lambda: called.append("reload")):
        signal.raise_signal(signal.SIGHUP)
    assert called == ["reload"]
    assert signal.getsignal(signal.SIGHUP) is before
