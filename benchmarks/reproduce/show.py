"""Show an experiment in a terminal."""

from __future__ import annotations

from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from .experiment import Column, Comparison, Experiment, Reading

# Smaller lengths are rounding errors [m].
ROUNDING_M = 1e-12


def show(console: Console, experiment: Experiment, plot: Path) -> None:
    """Print the paper's figures and ours, other models, interpretations of the paper, and the plot's path."""
    console.print()
    console.print(_readings(experiment))
    console.print()
    if experiment.comparison is not None:
        console.print(_comparison(experiment.comparison))
        console.print()
    for note in experiment.notes:
        console.print(note, style="dim")
    console.print(f"plot  {plot}", highlight=False, soft_wrap=True)


def mm(length_m: float | None) -> str:
    """Return a length in mm with three digits; rounding errors are marked as such."""
    if length_m is None:
        return "-"
    if length_m < ROUNDING_M:
        return f"< {1e3 * ROUNDING_M:.0e}"
    value = 1e3 * length_m
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _readings(experiment: Experiment) -> Table:
    """Return a table of the figures, with the paper's value above the results of each interpretation."""
    table = Table(title=experiment.title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("")
    table.add_column("its method, here", justify="right")
    said = ""
    for reading in experiment.readings:
        if reading.what != said:
            said = reading.what
            table.add_row(said, f"paper: {reading.paper}", style="bold")
        table.add_row(f"  {reading.read_as}", _value(reading))
    return table


def _value(reading: Reading) -> str:
    if reading.value is None:
        return "not reached"
    if reading.unit == "m":
        return f"{mm(reading.value)} mm"
    return f"{reading.value:,.0f}" if reading.unit == "samples" else f"{reading.value:.2g} s"


def _comparison(comparison: Comparison) -> Table:
    """Return a table with a column for each number of pairs; the models are grouped by test set."""
    counts = sorted({column.count for column in comparison.columns})
    table = Table(
        title=f"{comparison.title} [mm]", title_justify="left", box=SIMPLE_HEAD, pad_edge=False, show_edge=False
    )
    table.add_column("after so many pairs")
    for count in counts:
        table.add_column(f"{count:,}", justify="right", no_wrap=True)
    for test in dict.fromkeys(column.test for column in comparison.columns):
        table.add_row(test, style="bold")
        for name, errors in comparison.rows.items():
            told = dict(zip(comparison.columns, errors, strict=True))
            cells = (mm(told[at]) if (at := Column(test, count)) in told else "" for count in counts)
            table.add_row(f"  {name}", *cells)
    return table
