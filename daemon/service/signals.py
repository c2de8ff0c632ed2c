"""Handle SIGTERM and SIGINT as requests for an orderly end, and SIGHUP as a request to read robot.toml again."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

PARENT = "_BODYSCHEMA_PARENT"
# A pipe to the parent, which waits for a line.
SERVING = "_BODYSCHEMA_SERVING"
# prctl(2): the signal that the kernel sends when the parent dies.
PR_SET_PDEATHSIG = 1


def with_parent() -> dict[str, str]:
    """Return the environment for a child that must not outlive this process; start it from the main thread."""
    return {PARENT: str(os.getpid())}


def end_with_parent() -> None:
    """Arrange an orderly end on the parent's death, if the parent asked for it by `with_parent`."""
    parent = os.environ.pop(PARENT, None)
    if parent is None:
        return
    import ctypes

    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):  # the parent died before the kernel was informed
        sys.exit(1)


def tell_parent_serving() -> None:
    """Report to a parent that requested it by `SERVING` that this process has started and works."""
    pipe = os.environ.pop(SERVING, None)
    if pipe is not None:
        with suppress(OSError), open(int(pipe), "wb", buffering=0) as parent:
            parent.write(b"\n")


class SignalFlags:
    """Requests that came by signals: plain attributes, which a signal handler may set."""

    ending = reloading = False

    def end(self) -> None:
        """Request the end of the process."""
        self.ending = True

    def reload(self) -> None:
        """Request that robot.toml is read again."""
        self.reloading = True


@contextmanager
def on_termination(stop: Callable[[], None], *, reload: Callable[[], None] | None = None) -> Iterator[None]:
    """Call `stop` on SIGTERM or SIGINT, and `reload` on SIGHUP.

    Both run between two instructions of the main thread, which may hold any lock: they must only set a plain attribute
    (`threading.Event.set` can wait for a lock that the interrupted thread holds).
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
