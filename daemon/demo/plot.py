"""The learning curve as numbers and as a picture."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class CurveRow:
    """One moment of the demo: errors are mean distances [m]; the truth is known to the judge alone.

    `angle_rad` is the mean angle to the true orientation on held-out poses [rad], None where none is learnt.
    """

    pairs: int
    truth_m: float
    claimed_m: float | None
    prequential_m: float | None
    nominal_m: float
    angle_rad: float | None = None


def write_curve(rows: Sequence[CurveRow], file: Path) -> None:
    """The curve as CSV, in mm and degrees; the angles are there where orientations are learnt."""
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
    """The curve as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(9, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    pairs = [row.pairs for row in rows]
    nan = float("nan")
    axes.plot(pairs, [1e3 * row.nominal_m for row in rows], color="0.6", label="nominal model")
    axes.plot(
        pairs,
        [1e3 * (nan if row.prequential_m is None else row.prequential_m) for row in rows],
        color="tab:orange",
        alpha=0.7,
        label="error on each new pair before it is learnt",
    )
    axes.plot(
        pairs,
        [1e3 * (nan if row.claimed_m is None else row.claimed_m) for row in rows],
        color="tab:green",
        linestyle="--",
        label="error that the learner claims",
    )
    axes.plot(pairs, [1e3 * row.truth_m for row in rows], color="tab:blue", linewidth=2, label="held-out poses, truth")
    if change_at is not None:
        axes.axvline(change_at, color="tab:red", linewidth=1)
        axes.annotate(
            "tool change",
            (change_at, 0.7),
            xycoords=("data", "axes fraction"),
            xytext=(-4, 0),
            textcoords="offset points",
            ha="right",
            color="tab:red",
        )
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.set_xlabel("accepted pairs")
    axes.set_ylabel("mean error [mm]")
    axes.set_title("Learning the arm's forward kinematics while it is guided by hand (simulation)")
    figure.legend(loc="outside lower center", ncols=4, fontsize=9)
    figure.savefig(file, dpi=120)
