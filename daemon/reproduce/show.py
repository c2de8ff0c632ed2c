"""An experiment on the terminal."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table

from .experiment import Comparison, Experiment, Reading

# Lengths below are rounding errors [m].
ROUNDING_M = 1e-12


def show(console: Console, experiment: Experiment, plot: Path) -> None:
    """The paper's figures beside ours, other models, what was read into the paper, and where the plot is."""
    console.print()
    console.print(_readings(experiment))
    if experiment.comparison is not None:
        console.print(_comparison(experiment.comparison))
    for note in experiment.notes:
        console.print(note, style="dim")
    console.print(f"plot  {plot}", highlight=False, soft_wrap=True)


def mm(length_m: float | None) -> str:
    """A length in mm, in three digits; rounding errors are told as such."""
    if length_m is None:
        return "-"
    if length_m < ROUNDING_M:
        return f"< {1e3 * ROUNDING_M:.0e}"
    value = 1e3 * length_m
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _readings(experiment: Experiment) -> Table:
    table = Table(title=experiment.title, title_justify="left")
    table.add_column("")
    table.add_column("read as")
    table.add_column("paper")
    table.add_column("its method, here", justify="right")
    said = ""
    for reading in experiment.readings:
        same = reading.what == said
        said = reading.what
        table.add_row("" if same else said, reading.read_as, "" if same else reading.paper, _value(reading))
    return table


def _value(reading: Reading) -> str:
    if reading.value is None:
        return "not reached"
    if reading.unit == "m":
        return f"{mm(reading.value)} mm"
    return f"{reading.value:,.0f}" if reading.unit == "samples" else f"{reading.value:.2f} s"


def _comparison(comparison: Comparison) -> Table:
    """Models are columns: their names are short, and the rows say where they were tested."""
    table = Table(title=f"{comparison.title} [mm]", title_justify="left")
    table.add_column("")
    for name in comparison.rows:
        table.add_column(name, justify="right")
    for place, where in enumerate(comparison.columns):
        table.add_row(where, *(mm(errors[place]) for errors in comparison.rows.values()))
    return table
