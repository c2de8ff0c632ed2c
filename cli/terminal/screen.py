"""Pieces of terminal screens that several commands share."""

from __future__ import annotations

import math
from collections.abc import Collection

from rich.table import Table
from rich.text import Text

from bodyschema.daemon.transport.status import JointRange, SamplerStatus

BAR_WIDTH = 24


def mm(metres: float | None, unit: str = " mm") -> str:
    """Return a length in mm with sensible digits; a dash for None."""
    if metres is None or not math.isfinite(metres):
        return "-"
    value = 1e3 * metres
    return f"{value:.{0 if value >= 100 else 1 if value >= 1 else 2 if value >= 0.1 else 3}f}{unit}"


def degrees(radians: float | None, unit: str = "°") -> str:
    """Return a small angle in degrees with sensible digits; a dash for None."""
    if radians is None or not math.isfinite(radians):
        return "-"
    value = math.degrees(radians)
    return f"{value:.{1 if value >= 10 else 2 if value >= 1 else 3}f}{unit}"


def two_digits(value: float) -> str:
    """Return a positive number with two significant digits, never in powers of ten."""
    if value <= 0.0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:.{max(1 - math.floor(math.log10(value)), 0)}f}"


def titled_table(title: str, *, numbers: bool = True) -> Table:
    """Return an empty table without lines: names on the left and, by default, numbers on the right."""
    table = Table(box=None, pad_edge=False, show_header=False, title=Text(title, style="bold"), title_justify="left")
    table.add_column(no_wrap=True)
    if numbers:
        table.add_column(justify="right", no_wrap=True)
    return table


def rejected(status: SamplerStatus) -> list[tuple[str, int]]:
    """Return a text of the rejected frames by reason, the most frequent first."""
    return [
        (reason.replace("_", " "), count)
        for reason, count in sorted(status.rejected.items(), key=lambda item: -item[1])
    ]


def coverage_table(status: SamplerStatus, slides: Collection[str] = ()) -> Table:
    """Return a table of the part of each joint's range that accepted pairs have covered.

    Args:
        slides: names of the prismatic joints.
    """
    table = titled_table("joint coverage", numbers=False)
    table.add_column(no_wrap=True)
    table.add_column(justify="right", no_wrap=True)
    for name, joint in status.coverage.items():
        table.add_row(name, bar(joint), _metres(joint) if name in slides else _degrees(joint))
    return table


def _degrees(joint: JointRange) -> str:
    return f"{math.degrees(joint.low):+.0f}° … {math.degrees(joint.high):+.0f}°"


def _metres(joint: JointRange) -> str:
    return f"{joint.low:+.3f} m … {joint.high:+.3f} m"


def bar(joint: JointRange) -> Text:
    """Return a bar of the part of its range that a joint has covered."""
    span = (joint.upper_limit - joint.lower_limit) or 1.0
    first = round(BAR_WIDTH * (joint.low - joint.lower_limit) / span)
    last = round(BAR_WIDTH * (joint.high - joint.lower_limit) / span)
    first = min(max(first, 0), BAR_WIDTH - 1)
    last = min(max(last, first + 1), BAR_WIDTH)
    return Text("·" * first + "█" * (last - first) + "·" * (BAR_WIDTH - last), style="cyan")
