"""A `ChainReport` as a table for people: millimetres and degrees, joints counted from 1."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kbmaps.chains.report import ChainReport, Interval

_DEG = math.degrees(1.0)
_MM = 1e3
_AXES = ("x", "y", "z")


def report_text(report: ChainReport) -> str:
    """Return the figures with their 95 % intervals, one per line, then the data they rest on."""
    lines = [f"{'':<14}{'change':>10}   95 %"]
    lines += _of_axes("base shift", report.base_translation, "mm", _MM)
    lines += _of_axes("base turn", report.base_rotation, "deg", _DEG)
    lines += _of_axes("tool", report.tool_shift, "mm", _MM)
    for k, slides in enumerate(report.prismatic):
        unit, scale = ("mm", _MM) if slides else ("deg", _DEG)
        lines.append(_line(f"joint {k + 1} zero", unit, scale, report.zeros, k))
    lines.append(f"noise {_MM * report.noise:.3g} mm, misfit {report.misfit:.2f}, outliers left out: {report.outliers}")
    lines.append(f"directions of the parameters that the pairs show: {report.determined}")
    if report.undetermined:
        lines.append(f"Not shown, so about as believed before: {', '.join(report.undetermined)}.")
    return "\n".join(lines)


def _of_axes(name: str, interval: Interval, unit: str, scale: float) -> list[str]:
    return [_line(f"{name} {axis}", unit, scale, interval, k) for k, axis in enumerate(_AXES)]


def _line(name: str, unit: str, scale: float, interval: Interval, k: int) -> str:
    value, half = scale * float(interval.value[k]), scale * float(interval.half_width[k])
    # Adding 0.0 removes the sign of a rounded zero.
    return f"{name:<14}{round(value, 3) + 0.0:>10.3f} ± {half:.3f} {unit}"
