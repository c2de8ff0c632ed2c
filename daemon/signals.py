"""SIGTERM and SIGINT as a request to come to an orderly end, SIGHUP as one to read robot.toml again."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PARENT = "_BODYSCHEMA_PARENT"
# prctl(2): the signal that the kernel sends when the parent dies.
PR_SET_PDEATHSIG = 1


def with_parent() -> dict[str, str]:
    """Environment for a child that shall not outlive this process; start it from the main thread."""
    return {PARENT: str(os.getpid())}


def end_with_parent() -> None:
    """Come to an orderly end when the parent that asked for it by `with_parent` dies, however it dies."""
    parent = os.environ.pop(PARENT, None)
    if parent is None:
        return
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):  # it died before the kernel was told
        sys.exit(1)


class Wishes:
    """What signals ask of a process: plain attributes, which a handler may set."""

    ending = reloading = False

    def end(self) -> None:
        """Ask it to end."""
        self.ending = True

    def reload(self) -> None:
        """Ask it to read robot.toml again."""
        self.reloading = True


@contextmanager
def on_termination(stop: Callable[[], None], *, reload: Callable[[], None] | None = None) -> Iterator[None]:
    """Call `stop` when SIGTERM or SIGINT comes, and `reload` when SIGHUP does.

    Both run between two instructions of the main thread, which may be holding any lock: they must only set a plain
    attribute (`threading.Event.set` can wait for a lock that the interrupted thread holds).
    """

    wanted = {signal.SIGTERM: stop, signal.SIGINT: stop} | ({} if reload is None else {signal.SIGHUP: reload})

    def handle(number: int, _frame: object) -> None:
        wanted[signal.Signals(number)]()

    before = {number: signal.signal(number, handle) for number in wanted}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
