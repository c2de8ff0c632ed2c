"""Run the tests in several processes that are forked after one collection: `pytest --forks 3`.

To collect costs seconds of CPU and hundreds of megabytes, which processes that start by themselves would each pay. The
tests of a file stay together and in their order; one that takes its process down fails, with those of its file that are
left.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from itertools import chain, pairwise
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait

import pytest
from _pytest.config import create_terminal_writer

Group = list[tuple[int, pytest.Item]]
TICKET_BYTES = 2


def pytest_addoption(parser: pytest.Parser) -> None:
    help_text = "run the tests in so many processes, forked after the collection; auto: three for two processors"
    parser.addoption("--forks", metavar="N", default="0", help=help_text)


def wanted(config: pytest.Config) -> int:
    """Return how many processes are asked for; half of the tests wait for processes, clocks or disks."""
    asked = config.getoption("--forks", "0")
    return (3 * len(os.sched_getaffinity(0)) + 1) // 2 if asked == "auto" else int(asked)


def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Run the tests in forks if that is asked for; otherwise return nothing: pytest runs them itself."""
    count = wanted(session.config)
    if count < 2 or session.config.option.collectonly or session.testsfailed:
        return None
    groups: dict[object, Group] = {}
    for number, item in enumerate(session.items):
        groups.setdefault(item.path, []).append((number, item))
    _Parent(session, list(groups.values())).run(count)
    return True


class _Parent:
    """The process that collected, forks and reports."""

    def __init__(self, session: pytest.Session, groups: list[Group]) -> None:
        self._session, self._groups = session, groups
        self._queue, tickets = os.pipe()
        with open(tickets, "wb") as stream:  # a pipe holds 32 thousand of them
            stream.write(b"".join(index.to_bytes(TICKET_BYTES) for index in range(len(groups))))
        self._left = set(range(len(session.items)))
        self._pids: dict[Connection, int] = {}
        self._running: dict[Connection, int] = {}
        self._started = 0

    def run(self, count: int) -> None:
        try:
            for _ in range(count):
                self._fork()
            while self._pids:
                for wire in wait(list(self._pids)):
                    assert isinstance(wire, Connection)
                    self._hear(wire)
        finally:
            for pid in self._pids.values():
                os.kill(pid, signal.SIGINT)
            for pid in self._pids.values():
                os.waitpid(pid, 0)
        for number in sorted(self._left):
            self._fail(number, "not run: its process was ended by a test before it")

    def _fork(self) -> None:
        ours, theirs = Pipe(duplex=False)
        self._started += 1
        if (pid := os.fork()) == 0:
            _work(self._session, self._groups, self._queue, theirs, f"fork-{self._started}")
        theirs.close()
        self._pids[ours] = pid

    def _hear(self, wire: Connection) -> None:
        try:
            number, reports = wire.recv()
        except EOFError:
            code = os.waitstatus_to_exitcode(os.waitpid(self._pids.pop(wire), 0)[1])
            if code != 0:
                if wire in self._running:
                    self._fail(self._running[wire], f"its process ended with exit code {code}")
                self._fork()  # for what is left; it ends at once where nothing is
            return
        if reports is None:
            self._running[wire] = number
            return
        self._left.discard(number)
        hook = self._session.config.hook
        for data in reports:
            report = hook.pytest_report_from_serializable(config=self._session.config, data=data)
            hook.pytest_runtest_logreport(report=report)
        if self._session.shouldfail:
            raise self._session.Failed(self._session.shouldfail)

    def _fail(self, number: int, why: str) -> None:
        self._left.discard(number)
        item = self._session.items[number]
        report = pytest.TestReport(item.nodeid, item.location, {}, "failed", why, "call")
        self._session.config.hook.pytest_runtest_logreport(report=report)


class _Reports:
    """What hears of the tests in a fork, in place of the terminal's reporter."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._tw = create_terminal_writer(config, os.fdopen(os.dup(2), "w"))  # for stacks at a time limit
        self.taken: list[object] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.taken.append(self._config.hook.pytest_report_to_serializable(config=self._config, report=report))


def _work(session: pytest.Session, groups: list[Group], queue: int, wire: Connection, name: str) -> None:
    """Run groups of tests in this new process, until there are none; never return."""
    code = 1
    try:
        reports = _settle(session.config, name)
        for (number, item), following in pairwise(chain(_taken(groups, queue), [None])):
            wire.send((number, None))
            reports.taken.clear()
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following and following[1])
            wire.send((number, reports.taken))
        code = 0
    except KeyboardInterrupt:
        session._setupstate.teardown_exact(None)
    finally:
        sys.stderr.flush()
        os._exit(code)


def _settle(config: pytest.Config, name: str) -> _Reports:
    """Give this process what it must not share: captured output, folders for files, the terminal."""
    plugins = config.pluginmanager
    if (capture := plugins.getplugin("capturemanager")) is not None:
        capture.stop_global_capturing()
    reports = _Reports(config)
    if capture is not None:
        capture.start_global_capturing()
        capture.suspend_global_capture()
    plugins.unregister(name="terminalreporter")
    plugins.register(reports, "terminalreporter")
    factory = config._tmp_path_factory
    factory._basetemp = factory.mktemp(name, numbered=False)
    return reports


def _taken(groups: list[Group], queue: int) -> Iterator[tuple[int, pytest.Item]]:
    """Yield the tests of a group, then those of the next one that no other process has taken."""
    while ticket := os.read(queue, TICKET_BYTES):
        yield from groups[int.from_bytes(ticket)]
