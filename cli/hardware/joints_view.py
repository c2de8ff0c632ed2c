"""Show the joints of an arm in a terminal of 80 columns."""

from __future__ import annotations

import math

import msgspec
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from bodyschema.cli.terminal.screen import bar
from bodyschema.daemon.service.remedies import as_typed

from .joints_watch import JointState, Seen

HINT = "Move one joint at a time. It went the other way? Correct "


def screen(seen: Seen) -> RenderableType:
    """Return a row for each joint, then the joint moved last and any problems."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("joint", no_wrap=True, max_width=18)
    for heading in ("ID", "angle", "°/s", "mA", "°C"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("covered of the URDF's range", no_wrap=True)
    for joint in seen.joints:
        table.add_row(*_row(joint))
    lines = [Text(seen.moved, "cyan")] if seen.moved else []
    lines += [Text(f"{HINT}{seen.signs_in}.", "dim")]
    lines += [Text(_beyond(joint, seen.signs_in), "yellow") for joint in seen.joints if not joint.within_limits]
    lines += [Text(as_typed(complaint), "yellow") for complaint in seen.health]
    lines += [Text(as_typed(seen.trouble), "red")] if seen.trouble else []
    return Group(table, *lines)


def as_json(seen: Seen) -> str:
    """Return one line of JSON."""
    return msgspec.json.encode(seen).decode()


def _row(joint: JointState) -> tuple[str | Text, ...]:
    return (
        joint.joint,
        "-" if joint.id is None else str(joint.id),
        f"{math.degrees(joint.angle):+.1f}°",
        f"{math.degrees(joint.velocity) + 0.0:+.0f}",
        "-" if joint.current is None else f"{1e3 * joint.current:+.0f}",
        "-" if joint.temperature_c is None else f"{joint.temperature_c:.0f}",
        bar(joint.range),
    )


def _beyond(joint: JointState, signs_in: str) -> str:
    low, high, lower, upper = (f"{math.degrees(x):+.0f}°" for x in (joint.low, joint.high, joint.lower, joint.upper))
    return (
        f"{joint.joint} was from {low} to {high}, its limits are {lower} to {upper}: "
        f"look at the URDF's limits, and {signs_in}"
    )
