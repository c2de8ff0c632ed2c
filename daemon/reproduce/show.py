"""An experiment on the terminal."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table

from .experiment import Experiment


def show(console: Console, experiment: Experiment, plot: Path) -> None:
    """The paper's figures beside ours, what was read into the paper, and where the plot is."""
    table = Table(title=experiment.title, title_justify="left")
    table.add_column("")
    table.add_column("paper")
    table.add_column("its method, here", justify="right")
    if any(reading.learner for reading in experiment.readings):
        table.add_column("this learner", justify="right")
    for reading in experiment.readings:
        row = (reading.what, reading.paper, reading.method, reading.learner)
        table.add_row(*row[: len(table.columns)])
    console.print()
    console.print(table)
    for note in experiment.notes:
        console.print(note, style="dim")
    console.print(f"plot  {plot}", highlight=False, soft_wrap=True)
