"""What the demo shows: a live screen on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from daemon.screen import coverage_table, mm, rejected_table

from .play import Outcome, Snapshot
from .scene import Scene

PLAIN_EVERY_S = 5.0


@contextmanager
def shown_on(console: Console) -> Iterator[Callable[[Snapshot], None]]:
    """A function that shows a snapshot on `console`."""
    if not console.is_terminal:
        yield _Lines(console)
        return
    with Live(Text("starting the processes …"), console=console, refresh_per_second=4) as live:
        yield lambda snapshot: live.update(_screen(snapshot))


class _Lines:
    def __init__(self, console: Console) -> None:
        self._console = console
        self._next = 0.0
        self._phase = ""

    def __call__(self, snapshot: Snapshot) -> None:
        if snapshot.phase != self._phase:
            self._phase, self._next = snapshot.phase, 0.0
            self._console.print(f"-- {self._phase}", highlight=False)
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + PLAIN_EVERY_S
        learner, verdict = snapshot.learner, snapshot.verdict
        truth = mm(verdict.error_m) if verdict else "-"
        rejected = sum(snapshot.sampler.rejected.values())
        self._console.print(
            f"{learner.pairs:5d} of {snapshot.target} pairs, {rejected} frames rejected; "
            f"error before learning each {mm(learner.prequential_m.get(learner.answering))}, "
            f"claimed {mm(learner.claimed_error_m)}, truth on held-out poses {truth}; "
            f"{snapshot.asker.answers} answers",
            highlight=False,
        )


def _screen(snapshot: Snapshot) -> RenderableType:
    sampler, learner = snapshot.sampler, snapshot.learner
    head = Table.grid(padding=(0, 1), expand=True)
    head.add_column(ratio=1)
    head.add_column(justify="right", no_wrap=True)
    head.add_row(
        ProgressBar(total=snapshot.target, completed=min(learner.pairs, snapshot.target)),
        f"{learner.pairs} of {snapshot.target} pairs, {sampler.pairs_per_s:.0f}/s",
    )
    body = Table.grid(padding=(0, 3), expand=True)
    body.add_column(ratio=1)
    body.add_column(ratio=1)
    body.add_row(Group(_errors(snapshot), Text(), _asker(snapshot)), rejected_table(sampler))
    body.add_row(coverage_table(sampler), Text())
    title = f"bodyschema demo: {snapshot.phase}"
    return Panel(Group(head, Text(), body), title=title, title_align="left", border_style="blue")


def _errors(snapshot: Snapshot) -> Table:
    learner, verdict = snapshot.learner, snapshot.verdict
    table = Table(box=None, pad_edge=False, title="mean error", title_justify="left", title_style="bold")
    table.add_column("", no_wrap=True)
    table.add_column("mm", justify="right", no_wrap=True)
    table.add_row("nominal model, held-out poses", mm(verdict.nominal_m if verdict else None, unit=""))
    table.add_row(
        "learnt model, held-out poses", Text(mm(verdict.error_m if verdict else None, unit=""), style="bold green")
    )
    table.add_row("the learner's own claim", mm(learner.claimed_error_m, unit=""))
    for name, error in learner.prequential_m.items():
        mark = " (answers)" if name == learner.answering else ""
        table.add_row(f"next pair, {name}{mark}", mm(error, unit=""))
    return table


def _asker(snapshot: Snapshot) -> Text:
    asker = snapshot.asker
    return Text(
        f"a third process asks all the while: {asker.answers} answers, "
        f"half within {asker.p50_ms:.1f} ms, slowest of the last second {asker.worst_ms:.0f} ms"
    )


def show_outcome(console: Console, outcome: Outcome, scene: Scene) -> None:
    """The summary at the end."""
    first, second = outcome.first_tool, outcome.second_tool
    table = Table(title="Mean error on held-out poses, against the simulated truth", title_justify="left")
    table.add_column("")
    table.add_column("pairs", justify="right")
    table.add_column("nominal model", justify="right")
    table.add_column("learnt model", justify="right")
    table.add_column("the learner claims", justify="right")
    table.add_column("within 1 sigma", justify="right")
    for name, chapter in (("first tool", first), ("250 mm longer tool", second)):
        table.add_row(
            name,
            str(chapter.pairs),
            mm(chapter.verdict.nominal_m),
            Text(mm(chapter.verdict.error_m), style="bold green"),
            mm(chapter.claimed_m),
            f"{100 * chapter.verdict.within_sigma:.0f} %",
        )
    console.print()
    console.print(table)
    console.print(f"{outcome.answers} predictions were asked for meanwhile, {outcome.unanswered} went unanswered.")
    console.print(
        "Held-out poses lie within a few degrees of where the arm was guided with that tool; none was learnt."
    )
    console.print()
    for what, file in (("recording", scene.recording_file), ("curve", scene.curve_file), ("plot", scene.plot_file)):
        console.print(f"{what:10s}{_short(file)}", highlight=False, soft_wrap=True)
    console.print()
    console.print(
        f"Next: `bodyschema replay {_short(scene.recording_file)} --robot {_short(scene.robot_file)}` learns it again; "
        "`bodyschema config init` begins with a robot of your own.",
        highlight=False,
        soft_wrap=True,
    )


def _short(file: object) -> str:
    from pathlib import Path

    path = Path(str(file))
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
