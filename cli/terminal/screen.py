"""Parts of terminal screens that several commands share."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bodyschema.daemon.transport.status import JointRange, SamplerStatus


class ScreenSettings:
    bar_width: int = 24  # characters
    tell_every_s: float = 5.0  # interval between two lines of progress


def mm(metres: float | None, unit: str = " mm") -> str:
    """Return a length in mm with sensible digits; a dash for None."""
    if metres is None or not math.isfinite(metres):
        return "-"
    value = 1e3 * metres
    return f"{value:.{0 if value >= 100 else 1 if value >= 1 else 2 if value >= 0.1 else 3}f}{unit}"


def degrees(radians: float | None, unit: str = "°") -> str:
    """Return a small angle in degrees with sensible digits; a dash for None."""
    if radians is None or not math.isfinite(radians):
        return "-"
    value = math.degrees(radians)
    return f"{value:.{1 if value >= 10 else 2 if value >= 1 else 3}f}{unit}"


def or_dash(value: float | None, form: str) -> str:
    """Return a number in this form; a dash for None."""
    return "-" if value is None else form.format(value)


def such_zeros(joints: Collection[str]) -> str:
    """Return the name of these joints' offsets in sentences."""
    return "its zero" if len(joints) == 1 else "their zeros"


def two_digits(value: float) -> str:
    """Return a positive number with two significant digits, never in powers of ten."""
    if value <= 0.0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:.{max(1 - math.floor(math.log10(value)), 0)}f}"


def titled_table(title: str, *, numbers: bool = True) -> Table:
    """Return an empty table without lines: names on the left and, by default, numbers on the right."""
    table = Table(box=None, pad_edge=False, show_header=False, title=Text(title, style="bold"), title_justify="left")
    table.add_column(no_wrap=True)
    if numbers:
        table.add_column(justify="right", no_wrap=True)
    return table


def ruled_table(first: str, *others: str) -> Table:
    """Return an empty table with a rule below its headings: texts on the left, numbers under the others."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column(Text(first), overflow="fold")
    for name in others:
        table.add_column(Text(name), justify="right", no_wrap=True)
    return table


def plain_table(*headings: str, right: Collection[str] = (), folded: Collection[str] = ()) -> Table:
    """Return an empty table without lines: `right` are the headings of numbers, `folded` those of long texts."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for name in headings:
        table.add_column(name, justify="right" if name in right else "left", no_wrap=name not in folded)
    return table


def rejected(status: SamplerStatus) -> list[tuple[str, int]]:
    """Return a text of the rejected frames by reason, the most frequent first."""
    from bodyschema.interfaces.rejections import rejection_text

    return [
        (rejection_text(reason), count) for reason, count in sorted(status.rejected.items(), key=lambda item: -item[1])
    ]


def coverage_table(status: SamplerStatus, slides: Collection[str] = ()) -> Table:
    """Return a table of the part of each joint's range that accepted pairs have covered.

    Args:
        slides: names of the prismatic joints.
    """
    table = titled_table("joint coverage", numbers=False)
    table.add_column(no_wrap=True)
    table.add_column(justify="right", no_wrap=True)
    for name, joint in status.coverage.items():
        covered = f"{math.degrees(joint.low):+.0f}° … {math.degrees(joint.high):+.0f}°"
        if name in slides:
            covered = f"{joint.low:+.3f} m … {joint.high:+.3f} m"
        table.add_row(name, bar(joint), covered)
    return table


def bar(joint: JointRange) -> Text:
    """Return a bar of the part of its range that a joint has covered."""
    span = (joint.upper_limit - joint.lower_limit) or 1.0
    first = round(ScreenSettings.bar_width * (joint.low - joint.lower_limit) / span)
    last = round(ScreenSettings.bar_width * (joint.high - joint.lower_limit) / span)
    first = min(max(first, 0), ScreenSettings.bar_width - 1)
    last = min(max(last, first + 1), ScreenSettings.bar_width)
    return Text("·" * first + "█" * (last - first) + "·" * (ScreenSettings.bar_width - last), style="cyan")


Say = Callable[[str], None]
T = TypeVar("T")


def quiet(_said: str) -> None:
    """Ignore progress messages."""


def counted(say: Say, what: str, items: Sequence[T]) -> Iterator[T]:
    """Yield the items in order; report `what` at once, and the number done every few seconds."""
    say(what)
    last_s = time.monotonic()
    for done, item in enumerate(items):
        if time.monotonic() - last_s >= ScreenSettings.tell_every_s:
            last_s = time.monotonic()
            say(f"{what}: {done:,} of {len(items):,}")
        yield item


@contextmanager
def shown_on(console: Console, name: str) -> Iterator[Say]:
    """Yield a function that shows messages: one updating line on a terminal, a line each elsewhere."""
    if not console.is_terminal:
        yield lambda text: console.print(f"{name}: {text}", highlight=False, soft_wrap=True)
        return
    # Imported here, because rich's bars take 20 ms.
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.table import Column

    words = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
    with Progress(SpinnerColumn(), TimeElapsedColumn(), words, console=console, transient=True) as line:
        step = line.add_task(name, total=None)
        yield lambda text: line.update(step, description=f"{name}: {text}")
