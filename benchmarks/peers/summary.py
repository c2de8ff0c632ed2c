"""The tables of docs/results/peers_tables.md: one for each number of pairs, a row for each task."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.peers.page import tests_of
from benchmarks.peers.problem import Competitor
from benchmarks.peers.results import Results, cell
from benchmarks.peers.tasks import Task
from benchmarks.tables import Column, Table

COMMAND = "python -m benchmarks.peers --seeds 50 --data FOLDER --json peers.json"
SIZES = (30, 100, 300, 1000, 3000)


def summary(results: Results, tasks: Sequence[Task], competitors: Sequence[Competitor]) -> list[Table]:
    """Return the mean errors [mm] of the last test of each task, the best of a row in bold."""
    tables = (_table(results, tasks, competitors, pairs) for pairs in SIZES)
    return [table for table in tables if table.rows]


def _table(results: Results, tasks: Sequence[Task], competitors: Sequence[Competitor], pairs: int) -> Table:
    ran = [(task, row) for task in tasks if (row := _row(results, task, competitors, pairs))]
    seeds = sorted(
        {len({key[3] for key in results.outcomes if key[0] == task.key and key[2] == pairs}) for task, _ in ran}
    )
    arms = " to ".join(str(count) for count in sorted({*seeds[:1], *seeds[-1:]}))
    learners = [Column(name, "", "{}") for name in ("floor", *(f"`{competitor.key}`" for competitor in competitors))]
    rows = [[task.title, *row] for task, row in ran]
    return Table.of(f"peers_{pairs}", [Column(f"task, {arms} arms"), *learners], rows, COMMAND)


def _seeds(results: Results, task: Task, pairs: int) -> int:
    return len({key[3] for key in results.outcomes if (key[0], key[2]) == (task.key, pairs)})


def _row(results: Results, task: Task, competitors: Sequence[Competitor], pairs: int) -> list[str]:
    """Return a row of the summary; empty if nothing was run."""
    tests = tests_of(task, results)
    if not tests:
        return []
    cells = [cell(results.of(task.key, competitor.key, pairs), tests[-1]) for competitor in competitors]
    means = [entry.mean for entry in cells if entry.mean is not None]
    if not means:
        return []
    return [
        _mm(results.bound(task.key, pairs, tests[-1])),
        *(_entry(entry.mean, entry.failed, entry.ran, min(means)) for entry in cells),
    ]


def _entry(mean: float | None, failed: int, ran: int, best: float) -> str:
    lost = f" ({failed} of {ran} failed)" if failed else ""
    if mean is None:
        return f"–{lost}"
    return f"{f'**{_mm(mean)}**' if mean <= 1.02 * best else _mm(mean)}{lost}"


def _mm(metres: float | None) -> str:
    if metres is None:
        return ""
    value = 1e3 * metres
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.2g}" if value < 1.0 else f"{value:.1f}"
