"""The tables of docs/results/goals.md and goals_table.md."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from benchmarks.goals.goal import Cell, Measured, Row, Verdict, judged, number
from benchmarks.goals.study import Values
from benchmarks.tables import Column, Table

# Values between these are shown with all three digits. Standard errors below this share of the value are not shown.
_LEAST_PLAIN, _LARGEST_PLAIN = 1e-3, 1e3
_NEGLIGIBLE = 1e-3
COMMAND = "python -m benchmarks.goals --json goals.json --data FOLDER"


def overview(rows: Iterable[Row], results: Mapping[str, Sequence[Values]]) -> Table:
    """Return one line for each row (the number of figures that meet their goal, and the verdict), and the totals."""
    judgements = [(row, [judged(figure, results) for figure in row.figures]) for row in rows]
    met, goals = sum(_met(cells) for _, cells in judgements), len(judgements)
    reached = sum(_standing(cells) == Verdict.MET.value for _, cells in judgements)
    figures = sum(len(cells) for _, cells in judgements)
    lines = [(f"**{row.name}**: {row.what}", [_met(cells), len(cells)], _standing(cells)) for row, cells in judgements]
    totals = "all", [met, figures], f"{reached} of {goals} met"
    columns = Column("goal"), Column("figures met", "", "{} of {}"), Column("verdict")
    return Table.of("goals", columns, [*lines, totals], COMMAND)


def table(rows: Iterable[Row], results: Mapping[str, Sequence[Values]]) -> Table:
    """Return all rows: each with its name and subject, and a line for each figure."""
    columns = [Column(name) for name in ("what", "goal", "measured", "bound", "seeds", "")]
    return Table.of("goals_figures", columns, (line for row in rows for line in _lines(row, results)), COMMAND)


def _met(cells: Sequence[Cell]) -> int:
    return sum(cell.verdict is Verdict.MET for cell in cells)


def _lines(row: Row, results: Mapping[str, Sequence[Values]]) -> Iterator[list[str]]:
    cells = [judged(figure, results) for figure in row.figures]
    yield [f"**{row.name}**: {row.what}", "", "", "", "", _standing(cells)]
    for cell in cells:
        seeds = f"{cell.seeds} of {cell.wanted}"
        yield [f"– {cell.figure.what}", _goal(cell), _shown(cell.measured), _shown(cell.bound), seeds, _mark(cell)]


def _standing(cells: Sequence[Cell]) -> str:
    verdicts = [cell.verdict for cell in cells]
    for verdict in (Verdict.NOT_MET, Verdict.OPEN):
        if verdict in verdicts:
            return verdict.value
    return Verdict.MET.value


def _goal(cell: Cell) -> str:
    """Format the goal; if the bound has raised it, append the original goal."""
    text = cell.goal.text()
    return text if cell.goal == cell.figure.goal else f"{text} ({cell.figure.goal.text()})"


def _mark(cell: Cell) -> str:
    return cell.verdict.value + (" (within 2 s.e.)" if cell.in_doubt else "")


def _shown(measured: Measured | None) -> str:
    if measured is None:
        return ""
    value, error = measured.value, measured.standard_error
    text = f"{value:#.3g}".rstrip(".") if _LEAST_PLAIN <= abs(value) < _LARGEST_PLAIN else number(value)
    return text + (f" ± {number(float(f'{error:.1g}'))}" if error and error > _NEGLIGIBLE * abs(value) else "")
