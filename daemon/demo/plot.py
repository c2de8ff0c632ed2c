"""The learning curve as numbers and as a picture."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class CurveRow:
    """One moment of the demo: errors are mean distances [m]; the truth is known to the judge alone."""

    pairs: int
    truth_m: float
    claimed_m: float | None
    prequential_m: float | None
    nominal_m: float


def write_curve(rows: Sequence[CurveRow], file: Path) -> None:
    """The curve as CSV, in mm."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["pairs", "held_out_error_mm", "claimed_error_mm", "prequential_error_mm", "nominal_error_mm"])
        for row in rows:
            errors = (row.truth_m, row.claimed_m, row.prequential_m, row.nominal_m)
            writer.writerow([row.pairs, *("" if e is None else f"{1e3 * e:.3f}" for e in errors)])


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
