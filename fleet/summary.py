"""Summary of the diagnoses of a fleet: units that are off, and causes that all units of a type share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import msgspec
from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bodyschema.diagnosis.report.numbers import mm, numbers_of, place, significant_numbers
from bodyschema.diagnosis.report.result import Cause
from bodyschema.diagnosis.report.text import in_order

from .diagnosing import Diagnosed, ReportProgress, ReportResult

FEWEST_TO_SHARE = 3  # with at least this many units, a cause of more than half of them is attributed to the description
# Causes of the robot's placement, which do not concern its type.
PLACED = ("camera_pose", "camera_moved", "tool_offset", "tool_slip")


class Row(msgspec.Struct, frozen=True, kw_only=True):
    name: str  # of the row, and of the report's folder
    recording: str  # its file
    robot: str  # name of its robot
    verdict: str | None  # of the diagnosis
    causes: tuple[str, ...]  # with their numbers, in words, the most important first
    gain_percent: float | None  # reduction of the RMS on held-out rows
    # aligned_mm, extended_mm: RMS there, without and with the causes
    aligned_mm: float | None
    extended_mm: float | None
    sentence: str | None  # the diagnosis in one sentence
    error: str | None  # why there is no diagnosis; then the others are null


class Shared(msgspec.Struct, frozen=True):
    """Cause shared by more than half of the units of a type."""

    cause: str  # effect and joint
    units: tuple[str, ...]  # the units that have it
    of: int  # number of diagnosed units


class Type(msgspec.Struct, frozen=True):
    """Units with the same joints."""

    joints: tuple[str, ...]  # their names
    well: tuple[str, ...]  # units without a finding
    off: dict[str, tuple[str, ...]]  # by unit, the causes that few other units have
    shared: tuple[Shared, ...]  # causes of most units: check their common description


class Summary(msgspec.Struct, frozen=True):
    rows: tuple[Row, ...]
    types: tuple[Type, ...]


def summary(results: Sequence[Diagnosed]) -> Summary:
    types: dict[tuple[str, ...], list[Diagnosed]] = {}
    for result in results:
        if result.file is not None:
            types.setdefault(result.joints, []).append(result)
    return Summary(tuple(map(row, results)), tuple(_type(joints, units) for joints, units in types.items()))


def row(result: Diagnosed) -> Row:
    file = result.file
    return Row(
        name=result.job.name,
        recording=str(result.job.recording),
        robot=result.robot,
        verdict=None if file is None else file.verdict,
        causes=() if file is None else tuple(_cause_text(cause, result.timed) for cause in in_order(file.causes)),
        gain_percent=None if file is None else file.gain.held_out_percent,
        aligned_mm=None if file is None else file.rms_mm.aligned,
        extended_mm=None if file is None else file.rms_mm.extended,
        sentence=None if file is None else file.sentence,
        error=result.error,
    )


def _cause_text(cause: Cause, timed: bool) -> str:
    """Return a cause with its numbers, such as `joint_scale at elbow: scale +2.01 ± 0.03 %`."""
    numbers = ", ".join(f"{number.label} {number}" for number in significant_numbers(numbers_of(cause, timed=timed)))
    return f"{place(cause)}: {numbers}" if numbers else place(cause)


def _type(joints: tuple[str, ...], units: Sequence[Diagnosed]) -> Type:
    has: dict[str, list[str]] = {}
    for unit in units:
        for cause in unit.file.causes if unit.file is not None else ():
            if cause.effect not in PLACED:
                has.setdefault(place(cause), []).append(unit.job.name)
    common = {cause for cause, names in has.items() if len(units) >= FEWEST_TO_SHARE and 2 * len(names) > len(units)}
    off: dict[str, tuple[str, ...]] = {}
    for unit in units:
        if unit.file is None or unit.file.verdict == "nothing_found":
            continue
        own = [_cause_text(cause, unit.timed) for cause in in_order(unit.file.causes) if place(cause) not in common]
        if unit.file.unexplained.depends_on:
            own.append(f"something unexplained that depends on {', '.join(unit.file.unexplained.depends_on)}")
        if own:
            off[unit.job.name] = tuple(own)
    well = tuple(u.job.name for u in units if u.file is not None and u.file.verdict == "nothing_found")
    shared = tuple(Shared(cause, tuple(has[cause]), len(units)) for cause in has if cause in common)
    return Type(joints, well, off, shared)


_STYLES = {"explained": "green", "nothing_found": "blue", "undecided": "yellow", "unexplained": "red"}


@contextmanager
def progress(console: Console, count: int) -> Iterator[tuple[ReportProgress, ReportResult]]:
    """Yield the callbacks of `diagnose_all`: progress bars on a terminal, otherwise one line per recording."""
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
    """Return sentences on the units of a type that are off, with the reason."""
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
