"""Show the doctor's checks in a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bodyschema.daemon.service.remedies import as_typed
from bodyschema.daemon.wiring.servos import Check

MARKS = {"ok": Text("✓", "green"), "warning": Text("!", "yellow"), "wrong": Text("✗", "red")}
INDENT = "    "


def show(console: Console, checks: Sequence[Check]) -> None:
    """Print a line for each check, below it the command that fixes it, and the summary."""
    for check in checks:
        line = Table.grid(padding=(0, 1))
        line.add_column(no_wrap=True)
        line.add_column(no_wrap=True, min_width=13)
        line.add_column(overflow="fold")
        line.add_row(MARKS[check.state], Text(check.subject), Text(as_typed(check.said)))
        console.print(line)
        if check.fix:  # not wrapped here, so that it can be copied
            console.print(Text(f"{INDENT}{as_typed(check.fix)}", "bold"), soft_wrap=True)
    console.print(_sum(checks))


def _sum(checks: Sequence[Check]) -> str:
    wrong = sum(check.state == "wrong" for check in checks)
    warnings = sum(check.state == "warning" for check in checks)
    if not wrong and not warnings:
        return "All is well."
    parts = [f"{wrong} wrong"] * bool(wrong) + [f"{warnings} that could be better"] * bool(warnings)
    return f"{', '.join(parts)}: the line below each says what to do."
