"""SIGTERM and SIGINT as a request to come to an orderly end, and a parent's death as another."""

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


@contextmanager
def on_termination(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` when SIGTERM or SIGINT comes.

    `stop` runs between two instructions of the main thread, which may be holding any lock: it must only set a plain
    attribute (`threading.Event.set` can wait for a lock that the interrupted thread holds).
    """

    def handle(_number: int, _frame: object) -> None:
        stop()

    before = {number: signal.signal(number, handle) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
