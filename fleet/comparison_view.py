"""Terminal view of a comparison of robots of one type."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bodyschema.cli.terminal.screen import mm

from .comparison import FEWEST_TO_JUDGE, Odd, TypeComparison, Unit


def view(comparisons: Sequence[TypeComparison], left_out: Sequence[str]) -> RenderableType:
    """Return a table for each type, then who was left out."""
    parts: list[RenderableType] = []
    for comparison in comparisons:
        parts += [*map(Text, sentences(comparison)), Padding(_table(comparison.units), (1, 0, 1, 0))]
    parts += [Text(f"! not compared: {reason}", style="yellow") for reason in left_out]
    return Group(*parts)


def sentences(comparison: TypeComparison) -> list[str]:
    """Return the compared robots and the outliers, in words."""
    units = comparison.units
    said = [
        f"{len(units)} robots with the joints {', '.join(comparison.joints)}, at {comparison.poses} common poses, each "
        "model laid on their median as a whole."
    ]
    if len(units) < FEWEST_TO_JUDGE:
        return [*said, "Of two robots, it is not possible to say which is the odd one."]
    off = [unit for unit in units if unit.is_off]
    if not off:
        said.append("None is farther from the others than the models claim to be wrong, and no figure stands out.")
    for unit in off:
        why = [figure_told(odd) for odd in unit.odd[:3]]
        told = f": {'; '.join(why)}" if why else "; none of its figures stands out alone"
        said.append(f"{unit.robot} is off by {mm(unit.apart.rms_mm / 1e3)} (RMS){told}.")
    return said


def figure_told(odd: Odd) -> str:
    """Return a figure that stands out, as `zero of elbow +2.1 ± 0.2°`."""
    factor, unit = (math.degrees(1.0), "°") if odd.unit == "rad" else (1e3, " mm")
    half = factor * odd.half_width
    digits = min(max(1 - math.floor(math.log10(half)), 0), 4) if half > 0.0 else 3
    return f"{odd.figure} {factor * odd.difference:+.{digits}f} ± {half:.{digits}f}{unit}"


def _table(units: Sequence[Unit]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("robot", overflow="fold")
    for name in ("RMS", "max", "claimed", "has data"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("camera moved", justify="right", no_wrap=True)
    table.add_column("stands out from the median by", overflow="fold")
    for unit in units:
        moved = "-"
        if unit.camera_moved_mm is not None and unit.camera_turned_deg is not None:
            moved = f"{mm(unit.camera_moved_mm / 1e3)}, {unit.camera_turned_deg:.2g}°"
        style = "bold red" if unit.is_off else ""
        table.add_row(
            Text(unit.robot, style=style),
            Text(mm(unit.apart.rms_mm / 1e3), style=style),
            mm(unit.apart.max_mm / 1e3),
            mm(unit.claimed_mm / 1e3),
            f"{unit.in_support:.0%}",
            moved,
            "\n".join(map(figure_told, unit.odd)) or "-",
        )
    return table
