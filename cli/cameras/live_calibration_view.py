"""Guide the person who holds the board: a screen on a terminal, lines elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.waits import LINE_EVERY_S
from bodyschema.vision.calibration.guidance import TILTED_EACH_WAY, WANTED_VIEWS, Coverage, cell_counts
from bodyschema.vision.calibration.live import Look, Outcome
from bodyschema.vision.calibration.view import Eye, all_px, image_of

from .live_calibration import Show, Shown

_DONE, _OPEN = ("✓", "green"), ("·", "yellow")


def now_text(shown: Shown) -> str:
    """Return a sentence on the outcome of the last pair of images."""
    look = shown.look
    if shown.doing:
        return shown.doing
    if look is None:
        return "no images"
    match look.outcome:
        case Outcome.TAKEN:
            return f"taken: view {shown.views}"
        case Outcome.MOVING:
            return "hold it still"
        case Outcome.KNOWN:
            return "there is a view like this one: move or tilt the board"
        case Outcome.UNSEEN:
            named = len(shown.coverage.eyes) > 1
            return "; ".join(f"{f'{each.eye} eye: ' if named else ''}{each.fault.text}" for each in look.unusable)


def screen(shown: Shown, heading: str) -> Group:
    """All of it, for 80 columns and 24 lines."""
    coverage = shown.coverage
    count = f"{coverage.whole_views} of {max(WANTED_VIEWS, coverage.whole_views)} views, {coverage.progress:.0%}"
    parts = Table.grid(padding=(0, 4))
    for _ in range(len(coverage.eyes) + 2):
        parts.add_column(no_wrap=True)
    titles = (*(image_of(eye, coverage.eyes) for eye in coverage.eyes), "tilted, edge away", "distance")
    parts.add_row(*(Text(title, style="bold") for title in titles))
    parts.add_row(*(_cells(coverage, shown.look, eye) for eye in coverage.eyes), _tilts(coverage), _distances(coverage))
    texts = [
        Text(f"{heading}: {count}", style="bold"),
        Text(""),
        Text(f"Next: {shown.wish}", style="bold cyan"),
        Text(f"Now:  {now_text(shown)}", style="green" if _is_taken(shown.look) else ""),
        Text(""),
        parts,
        Text(""),
        *(Text(trouble, style="yellow") for trouble in shown.trouble),
    ]
    if shown.refusal:
        texts.append(Text(f"Not good enough yet: {shown.refusal}", style="yellow"))
    texts.append(Text("█ covered   ○ the board is here   Ctrl-C: calibrate with what there is", style="dim"))
    return Group(*texts)


def _is_taken(look: Look | None) -> bool:
    return look is not None and look.outcome is Outcome.TAKEN


def _cells(coverage: Coverage, look: Look | None, eye: Eye) -> Table:
    """Return a table of the image's nine cells: those covered so far, and those the board is in now."""
    table = Table.grid()
    here = None
    if look is not None and look.view.eye(eye) is not None:
        here = cell_counts(all_px([look.view], eye), look.pair.size_px) > 0
    for row, covered in enumerate(coverage.covered(eye).tolist()):
        line = Text()
        for column, is_covered in enumerate(covered):
            is_here = here is not None and bool(here[row, column])
            line.append("█" if is_covered else "·", style="green" if is_covered else "yellow")
            line.append("○ " if is_here else "  ", style="bold cyan")
        table.add_row(line)
    return table


def _tilts(coverage: Coverage) -> Table:
    table = Table.grid(padding=(0, 2))
    for edge, count in coverage.tilted().items():
        done = count >= TILTED_EACH_WAY
        table.add_row(
            edge, Text(f"{min(count, TILTED_EACH_WAY)}/{TILTED_EACH_WAY}", style=(_DONE if done else _OPEN)[1])
        )
    return table


def _distances(coverage: Coverage) -> Table:
    table = Table.grid(padding=(0, 2))
    for name, done in (("near", coverage.has_near), ("far", coverage.has_far)):
        table.add_row(name, Text(*(_DONE if done else _OPEN)))
    return table


class Lines:
    """The same as lines: each view at once, what else changes every few seconds."""

    def __init__(self, say: Callable[[str], None], clock: Clock) -> None:
        self._say, self._clock = say, clock
        self._next_s = 0.0
        self._said: set[str] = set()
        self._wish = ""

    def __call__(self, shown: Shown) -> None:
        """Print what is new."""
        for text in (shown.refusal and f"not good enough yet: {shown.refusal}", *shown.trouble):
            self._once(text)
        if _is_taken(shown.look) or (shown.wish != self._wish and not shown.doing):
            self._wish = shown.wish
            said = f"{shown.coverage.whole_views} views, {shown.coverage.progress:.0%}. Next: {shown.wish}"
            self._say(f"{now_text(shown)}. {said}" if _is_taken(shown.look) else said)
            self._said.clear()
        elif shown.doing or (shown.look is not None and self._clock.now() >= self._next_s):
            self._next_s = self._clock.now() + LINE_EVERY_S
            self._once(now_text(shown))

    def _once(self, text: str) -> None:
        """Print the text, unless it was printed since the last view."""
        if text and text not in self._said:
            self._said.add(text)
            self._say(text)


@contextmanager
def guidance_on(console: Console, heading: str, clock: Clock) -> Iterator[Show]:
    """Yield a function that redraws a screen on a terminal and prints lines elsewhere."""
    if not console.is_terminal:
        yield Lines(lambda text: console.print(text, markup=False, highlight=False, soft_wrap=True), clock)
        return
    with Live(console=console, auto_refresh=False, transient=True) as live:
        yield lambda shown: live.update(screen(shown, heading), refresh=True)
