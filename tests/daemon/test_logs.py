from __future__ import annotations

import io
import logging
import signal
from collections.abc import Iterator

import pytest

from daemon import logs
from daemon.signals import on_termination


@pytest.fixture(autouse=True)
def root_logger() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:], root.level = handlers, level


def logged(environment: dict[str, str]) -> str:
    stream = io.StringIO()
    logs.set_up(environment=environment, stream=stream)
    logging.getLogger("daemon.sampler").warning("the disk\nis nearly full")
    logging.getLogger("daemon.sampler").info("all is well")
    logging.getLogger("daemon.sampler").debug("details")
    return stream.getvalue()


def test_the_journal_gets_a_priority_at_the_head_of_every_line() -> None:
    lines = logged({"JOURNAL_STREAM": "8:1"}).splitlines()
    assert lines == ["<4>daemon.sampler: the disk", "<4>is nearly full", "<6>daemon.sampler: all is well"]


def test_a_person_gets_time_and_level() -> None:
    assert logged({}).splitlines()[-1].endswith("INFO    daemon.sampler: all is well")


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
