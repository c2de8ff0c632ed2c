"""Write the learning curve as numbers and as a picture."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodyschema.diagnosis.report.plot import HEIGHT, WIDTH, Plot

_HEADING = "Forward kinematics learnt while the arm is guided (simulation)"
_TITLE, _LEGEND_LINE = 22, 14  # heights in the units of the plot, whose text is 10 to 11 high
_STYLE = (
    ".page{fill:#fff}text{font:10.5px system-ui,'DejaVu Sans',sans-serif;fill:#4d5662}"
    ".title{font-size:11px;fill:#1d2127}text.label{fill:#1d2127}text.named{fill:#b3261e}.grid{stroke:#e5e3de}.line{fill:none;stroke-width:1.6}"
    ".moment{stroke:#b3261e;stroke-dasharray:4 3}.nominal{stroke:#98a2af}.next{stroke:#e39a55;stroke-width:1}"
    ".expected{stroke:#14804a;stroke-dasharray:5 3}.truth{stroke:#1f78c8;stroke-width:2.2}"
)


@dataclass(frozen=True, slots=True)
class CurveRow:
    """One moment of the demo: mean errors against the simulator's ground truth [m].

    `angle_rad` is the mean angle to the true orientation on held-out poses [rad]; None if none is learnt.
    """

    pairs: int
    truth_m: float
    claimed_m: float | None
    prequential_m: float | None
    nominal_m: float
    angle_rad: float | None = None


def write_curve(rows: Sequence[CurveRow], file: Path) -> None:
    """Write the curve as CSV, in mm and degrees; angles only where orientations are learnt."""
    turned = any(row.angle_rad is not None for row in rows)
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        heading = ["pairs", "held_out_error_mm", "claimed_error_mm", "prequential_error_mm", "nominal_error_mm"]
        writer.writerow([*heading, "held_out_angle_deg"] if turned else heading)
        for row in rows:
            errors = (row.truth_m, row.claimed_m, row.prequential_m, row.nominal_m)
            angle = "" if row.angle_rad is None else f"{math.degrees(row.angle_rad):.4f}"
            cells = ["" if e is None else f"{1e3 * e:.3f}" for e in errors]
            writer.writerow([row.pairs, *cells, angle] if turned else [row.pairs, *cells])


def plot_curve(rows: Sequence[CurveRow], change_at: int | None, file: Path) -> None:
    """Write the curve as an SVG file, with the moment of the tool change."""
    curves = {
        "nominal model": ("nominal", [row.nominal_m for row in rows]),
        "error on each new sample before it is learnt": ("next", [row.prequential_m for row in rows]),
        "error that the learner expects": ("expected", [row.claimed_m for row in rows]),
        "ground truth: error on held-out poses": ("truth", [row.truth_m for row in rows]),
    }
    known = [1e3 * error for _, errors in curves.values() for error in errors if error]
    pairs = np.array([row.pairs for row in rows], dtype=np.float64)
    plot = Plot(
        "accepted samples",
        "mean error [mm]",
        (float(pairs.min()), float(pairs.max()) + 1.0),
        (0.8 * min(known), 1.25 * max(known)),
        log_y=True,
    )
    marks = []
    for look, errors in curves.values():
        there = np.array([bool(error) for error in errors])
        marks.append(plot.line(pairs[there], 1e3 * np.array([error for error in errors if error]), look))
    if change_at is not None:
        marks.append(plot.moment(float(change_at), "tool change"))
    file.write_text(_page(plot.svg(*marks), {text: look for text, (look, _) in curves.items()}), encoding="utf-8")


def _page(plot: str, legend: dict[str, str]) -> str:
    """Return a standalone SVG: a title, the plot, and a legend below it."""
    width, height = WIDTH, HEIGHT + _TITLE + _LEGEND_LINE * (len(legend) + 1)
    title = f'<text class="title" x="{width / 2}" y="16" text-anchor="middle">{_HEADING}</text>'
    entries = []
    for number, (text, look) in enumerate(legend.items(), 1):
        y = HEIGHT + _TITLE + _LEGEND_LINE * number
        entries.append(f'<path class="line {look}" d="M60 {y - 4}h24"/><text x="92" y="{y}">{text}</text>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{2 * width}" '
        f'height="{2 * height}"><style>{_STYLE}</style><rect class="page" width="{width}" height="{height}"/>{title}'
        f'<svg y="{_TITLE}" width="{WIDTH}" height="{HEIGHT}">{plot}</svg>{"".join(entries)}</svg>\n'
    )
