"""Show the demo: a live screen on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from bodyschema.cli.terminal.findings_view import outlook_sentence
from bodyschema.cli.terminal.screen import ScreenSettings, coverage_table, degrees, mm, rejected, titled_table
from bodyschema.daemon.transport.status import SamplerStatus

from .play import Outcome, Snapshot
from .scene import Scene


@contextmanager
def shown_on(console: Console) -> Iterator[Callable[[Snapshot], None]]:
    """Yield a function that shows a snapshot on `console`."""
    if not console.is_terminal:
        yield _Lines(console)
        return
    with Live(Text("starting the processes …"), console=console, refresh_per_second=4) as live:
        yield lambda snapshot: live.update(_screen(snapshot))


class _Lines:
    """Printer of lines of less than 80 characters, a few seconds apart, without repeats."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._next = 0.0
        self._phase = self._last_line = ""

    def __call__(self, snapshot: Snapshot) -> None:
        if snapshot.phase != self._phase:
            self._phase, self._next = snapshot.phase, 0.0
            self._console.print(f"-- {self._phase}", soft_wrap=True)
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + ScreenSettings.tell_every_s
        learner, verdict = snapshot.learner, snapshot.verdict
        truth, what = mm(verdict.error_m) if verdict else "-", "error: "
        if verdict and verdict.angle_rad is not None:
            truth, what = f"{truth} {degrees(verdict.angle_rad)}", ""  # no room for both
        line = (
            f"{learner.pairs:5d} of {snapshot.target} samples; "
            f"{what}next {mm(learner.prequential_m.get(learner.answering))}, "
            f"claimed {mm(learner.claimed_error_m)}, held out {truth}"
        )
        if line != self._last_line:
            self._last_line = line
            self._console.print(line, soft_wrap=True)


def _screen(snapshot: Snapshot) -> RenderableType:
    """Return the screen; with the demo's seven joints it has at most 23 lines, which fit a terminal of 24."""
    sampler, learner = snapshot.sampler, snapshot.learner
    head = Table.grid(padding=(0, 1), expand=True)
    head.add_column(ratio=1)
    head.add_column(justify="right", no_wrap=True)
    head.add_row(
        ProgressBar(total=snapshot.target, completed=min(learner.pairs, snapshot.target)),
        f"{learner.pairs} of {snapshot.target} samples, {sampler.pairs_per_s:.0f}/s",
    )
    body = Table.grid(padding=(0, 4))
    body.add_row(_errors(snapshot), _frames(sampler))
    return Panel(
        Group(head, Text(), body, Text(), coverage_table(sampler), Text(), _asker(snapshot)),
        title=f"bodyschema demo: {snapshot.phase}",
        title_align="left",
        border_style="blue",
    )


def _errors(snapshot: Snapshot) -> Table:
    learner, verdict = snapshot.learner, snapshot.verdict
    table = titled_table("mean error [mm]")
    table.add_row("held-out poses, nominal model", mm(verdict.nominal_m if verdict else None, unit=""))
    table.add_row(
        "held-out poses, learnt model", Text(mm(verdict.error_m if verdict else None, unit=""), style="bold green")
    )
    table.add_row("the same, as the learner claims", mm(learner.claimed_error_m, unit=""))
    if verdict is not None and verdict.angle_rad is not None:
        table.add_row("how the marker is turned, held out [°]", degrees(verdict.angle_rad, unit=""))
    for name, error in learner.prequential_m.items():
        mark = " (answers)" if name == learner.answering else ""
        table.add_row(f"next sample, {name}{mark}", mm(error, unit=""))
    return table


def _frames(status: SamplerStatus) -> Table:
    table = titled_table("frames")
    table.add_row("seen", str(status.frames))
    table.add_row("accepted as samples", Text(str(status.pairs), style="bold green"))
    for reason, count in rejected(status):
        table.add_row(f"rejected: {reason}", str(count))
    return table


def _asker(snapshot: Snapshot) -> Text:
    asker = snapshot.asker
    return Text(
        f"{asker.answers} answers to a third process, half in {asker.p50_ms:.1f} ms, slowest {asker.worst_ms:.0f} ms"
    )


def show_outcome(console: Console, outcome: Outcome, scene: Scene) -> None:
    """Print the summary at the end."""
    first, second = outcome.first_tool, outcome.second_tool
    table = Table(title="Mean error on held-out poses, against the simulated truth", title_justify="left")
    table.add_column("", no_wrap=True)
    for heading in ("samples", "nominal", "learnt", "claimed", "within 1σ"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, chapter in (("first tool", first), ("tool 250 mm longer", second)):
        table.add_row(
            name,
            str(chapter.pairs),
            mm(chapter.verdict.nominal_m),
            Text(mm(chapter.verdict.error_m), style="bold green"),
            mm(chapter.predicted_m),
            f"{100 * chapter.verdict.within_sigma:.0f} %",
        )
    console.print()
    console.print(table)
    console.print(
        "Held-out poses lie within a few degrees of where the arm was guided with that tool; none was learnt. "
        "Claimed errors are the learner's own estimates. A third process asked for "
        f"{outcome.answers + outcome.unanswered} predictions meanwhile; {outcome.unanswered} went unanswered."
    )
    for name, chapter in (("first tool", first), ("tool 250 mm longer", second)):
        if chapter.verdict.angle_rad is not None and chapter.verdict.angles_within_sigma is not None:
            console.print(
                f"\nHow the marker is turned, {name}: {degrees(chapter.verdict.angle_rad)} from the truth on held-out "
                f"poses; claimed {degrees(chapter.claimed_rad)}; {chapter.verdict.angles_within_sigma:.0%} within 1σ."
            )
    if second.outlook is not None:
        console.print(f"\n{outlook_sentence(second.outlook)}")
    console.print()
    for what, file in (("recording", scene.recording_file), ("curve", scene.curve_file), ("plot", scene.plot_file)):
        console.print(f"{what:10s}{_short(file)}", soft_wrap=True)
    console.print()
    console.print(
        f"Next: `bodyschema replay {_short(scene.first_tool_file)}` learns it again;\n"
        "`bodyschema init` begins with a robot of your own.",
        soft_wrap=True,
    )


def _short(file: Path) -> str:
    return str(file.relative_to(Path.cwd())) if file.is_relative_to(Path.cwd()) else str(file)
