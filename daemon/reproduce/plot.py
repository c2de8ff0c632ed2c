"""The figures as pictures."""

from __future__ import annotations

from pathlib import Path

from .experiment import Experiment


def plot(experiment: Experiment, file: Path) -> None:
    """The curves as a PNG: thick lines are mean errors, dotted ones the largest, as in the paper."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for curve in experiment.curves:
        marker, width = "o" if len(curve.count) == 1 else None, 0.6 if curve.thin else 2.0
        above = [1e3 * max(value, experiment.floor_m) for value in curve.mean]
        order = 1 if curve.thin else 2
        axes.plot(curve.count, above, color=curve.colour, lw=width, marker=marker, label=curve.name, zorder=order)
        if curve.largest:
            above = [1e3 * max(value, experiment.floor_m) for value in curve.largest]
            axes.plot(curve.count, above, color=curve.colour, lw=1, linestyle=":")
    axes.set_yscale("log")
    axes.set_xlabel(experiment.counted)
    axes.set_ylabel("error [mm]; dotted: the largest")
    axes.set_title(experiment.title, loc="left", fontsize=10)
    axes.grid(visible=True, which="major", alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    figure.savefig(file, dpi=120)
