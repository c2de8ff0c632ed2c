"""Show the servos of the sampler's status in a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Mapping

from rich.table import Table
from rich.text import Text

from bodyschema.daemon.transport.status import ServoStatus


def servos_table(servos: Mapping[str, ServoStatus]) -> Table:
    """Return a table of each joint's servo: identity, health, and problems in the last column."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    for heading in ("servo", "ID", "model", "fw", "supply", "temp.", "current", "state"):
        right = heading in ("ID", "fw", "supply", "temp.", "current")
        table.add_column(heading, justify="right" if right else "left", no_wrap=heading != "state")
    for joint, servo in servos.items():
        figures = (
            _or_dash(servo.voltage_v, "{:.1f} V"),
            _or_dash(servo.temperature_c, "{:.0f} °C"),
            _or_dash(servo.current_a, "{:.2f} A"),
        )
        state = Text(_short(servo), style="red") if servo.troubles else Text("well", style="green")
        table.add_row(joint, str(servo.id), servo.model, str(servo.firmware), *figures, state)
    return table


def _short(servo: ServoStatus) -> str:
    """Return the problem without its remedy, which is printed above the table."""
    return ", ".join(trouble.split(":")[0] for trouble in servo.troubles)


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)
