"""Pieces of terminal screens that more than one command shows."""

from __future__ import annotations

import math

from rich.table import Table
from rich.text import Text

from .status import JointRange, SamplerStatus

BAR_WIDTH = 24


def mm(metres: float | None, unit: str = " mm") -> str:
    """A length in mm with sensible digits; a dash for none."""
    if metres is None or not math.isfinite(metres):
        return "-"
    value = 1e3 * metres
    return f"{value:.{0 if value >= 100 else 1 if value >= 1 else 2}f}{unit}"


def rejected_table(status: SamplerStatus) -> Table:
    """Frames, accepted pairs, and rejected frames by reason."""
    table = Table(box=None, pad_edge=False, title="frames", title_justify="left", title_style="bold")
    table.add_column("", no_wrap=True)
    table.add_column("", justify="right", no_wrap=True)
    table.add_row("seen", str(status.frames))
    table.add_row("accepted as pairs", Text(str(status.pairs), style="bold green"))
    for reason, count in sorted(status.rejected.items(), key=lambda item: -item[1]):
        table.add_row(f"rejected: {reason.replace('_', ' ')}", str(count))
    return table


def coverage_table(status: SamplerStatus) -> Table:
    """For each joint, which part of its range accepted pairs have covered."""
    table = Table(box=None, pad_edge=False, title="joint coverage", title_justify="left", title_style="bold")
    table.add_column("", no_wrap=True)
    table.add_column("", no_wrap=True)
    table.add_column("", justify="right", no_wrap=True)
    for name, joint in status.coverage.items():
        covered = f"{math.degrees(joint.low):+.0f}° … {math.degrees(joint.high):+.0f}°"
        table.add_row(name, _bar(joint), covered)
    return table


def _bar(joint: JointRange) -> Text:
    span = (joint.upper_limit - joint.lower_limit) or 1.0
    first = round(BAR_WIDTH * (joint.low - joint.lower_limit) / span)
    last = round(BAR_WIDTH * (joint.high - joint.lower_limit) / span)
    first = min(max(first, 0), BAR_WIDTH - 1)
    last = min(max(last, first + 1), BAR_WIDTH)
    return Text("·" * first + "█" * (last - first) + "·" * (BAR_WIDTH - last), style="cyan")
