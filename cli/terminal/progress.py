"""Report the progress of an experiment while it runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console

Say = Callable[[str], None]
T = TypeVar("T")

TELL_EVERY_S = 5.0


def quiet(_said: str) -> None:
    """Ignore progress messages."""


def counted(say: Say, what: str, items: Sequence[T]) -> Iterator[T]:
    """Yield the items in order; report `what` at once, and every few seconds the number done."""
    say(what)
    told = time.monotonic()
    for done, item in enumerate(items):
        if time.monotonic() - told >= TELL_EVERY_S:
            told = time.monotonic()
            say(f"{what}: {done:,} of {len(items):,}")
        yield item


@contextmanager
def shown_on(console: Console, name: str) -> Iterator[Say]:
    """Yield a function that shows messages: one updating line on a terminal, a line each elsewhere."""
    if not console.is_terminal:
        yield lambda said: console.print(f"{name}: {said}", highlight=False, soft_wrap=True)
        return
    # Imported here, because rich's bars take 20 ms.
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.table import Column

    words = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
    with Progress(SpinnerColumn(), TimeElapsedColumn(), words, console=console, transient=True) as line:
        step = line.add_task(name, total=None)
        yield lambda said: line.update(step, description=f"{name}: {said}")
