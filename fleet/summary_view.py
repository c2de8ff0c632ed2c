"""Terminal view of a fleet's diagnoses, during the run and at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bodyschema.diagnosis.report.numbers import mm

from .diagnosing import Diagnosed, Done, Told
from .summary import Row, Summary, Type

_STYLES = {"explained": "green", "nothing_found": "blue", "undecided": "yellow", "unexplained": "red"}


@contextmanager
def progress(console: Console, count: int) -> Iterator[tuple[Told, Done]]:
    """Yield the callbacks of `diagnose_all`: progress bars on a terminal, elsewhere one line per recording."""
    if not console.is_terminal:
        finished = 0

        def done(result: Diagnosed) -> None:
            nonlocal finished
            finished += 1
            console.print(f"{finished} of {count}: {_outcome(result)}", soft_wrap=True, markup=False)

        yield lambda _name, _said: None, done
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Column

    words = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
    with Progress(MofNCompleteColumn(), BarColumn(20), TimeElapsedColumn(), words, console=console) as bars:
        whole = bars.add_task("reading", total=count)

        def finish(result: Diagnosed) -> None:
            bars.update(whole, advance=1, description="")
            bars.console.print(_outcome(result), markup=False)

        yield lambda name, said: bars.update(whole, description=f"{name}: {said}"), finish


def _outcome(result: Diagnosed) -> str:
    if result.file is None:
        return f"{result.job.name}: {result.error}"
    return f"{result.job.name}: {result.file.verdict.replace('_', ' ')}"


def view(summary: Summary) -> RenderableType:
    """Return a table with one row per recording, the failures, then the units of each type that are off."""
    with_robots = len({row.robot for row in summary.rows if row.error is None}) > 1
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("recording", overflow="fold")
    if with_robots:
        table.add_column("robot", overflow="fold")
    table.add_column("verdict", no_wrap=True)
    table.add_column("causes", overflow="fold")
    table.add_column(Text("RMS [mm]"), justify="right", no_wrap=True)
    table.add_column("gain", justify="right", no_wrap=True)
    for row in summary.rows:
        names = [Text(row.name), Text(row.robot)] if with_robots else [Text(row.name)]
        table.add_row(*names, *_cells(row))
    failed = [Text(f"! {row.name}: {row.error}", style="yellow") for row in summary.rows if row.error is not None]
    parts: list[RenderableType] = [table, *([Padding(Group(*failed), (1, 0, 0, 0))] if failed else [])]
    for one in summary.types:
        lines = [Text(sentence) for sentence in sentences(one)]
        parts += [Padding(Group(*lines), (1, 0, 0, 0))] if lines else []
    return Group(*parts)


def sentences(one: Type) -> list[str]:
    """Return sentences on the units of a type that are off, and why."""
    units = len(one.well) + len(one.off)
    said = [f"{name} is off: {'; '.join(why)}." for name, why in one.off.items()]
    if one.well:
        said.append(f"Nothing is wrong with {', '.join(one.well)}.")
    for shared in one.shared:
        said.append(
            f"{len(shared.units)} of {shared.of} units have {shared.cause} ({', '.join(shared.units)}): look at the "
            "robot's description before the robots."
        )
    return [f"Joints {', '.join(one.joints)}:", *said] if units + len(one.shared) > 0 else []


def _cells(row: Row) -> tuple[RenderableType, ...]:
    if row.error is not None or row.verdict is None:
        return Text("failed", style="red"), "-", "-", "-"
    return (
        Text(row.verdict.replace("_", " "), style=_STYLES.get(row.verdict, "")),
        Text("\n".join(row.causes) or "-"),
        f"{mm(row.aligned_mm)} → {mm(row.extended_mm)}",
        "-" if row.gain_percent is None else f"{row.gain_percent:.0f} %",
    )
