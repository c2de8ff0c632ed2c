"""SIGTERM and SIGINT as a request to come to an orderly end."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager


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
