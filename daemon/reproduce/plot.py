"""The figures as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .experiment import Curve, Experiment, Panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Curves with so few points get markers.
_FEW = 12


def plot(experiment: Experiment, file: Path) -> None:
    """The panels side by side as a PNG: thick lines are mean errors, dotted ones the largest, as in the paper."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = experiment.panels
    figure = Figure(figsize=(6.5 * len(panels), 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(experiment.title, fontsize=11)
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw(axes, panel, experiment.floor_m)
        axes.set_xlabel(experiment.counted)
    figure.savefig(file, dpi=100)


def _draw(axes: Axes, panel: Panel, floor_m: float) -> None:
    lowest = 1e3 * floor_m
    for order, curve in enumerate(sorted(panel.curves, key=lambda curve: not curve.thin)):
        _line(axes, curve, floor_m, order, largest=panel.largest)
    axes.set_yscale("log")
    if any(mean < floor_m for curve in panel.curves for mean in curve.mean):
        axes.axhline(lowest, color="grey", lw=0.6)
        where = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
        axes.annotate(f"below {lowest:g} mm", (1.0, lowest), fontsize=7, color="grey", **where)
    axes.set_ylabel("error [mm]; dotted: the largest" if panel.largest else "mean error [mm]")
    axes.set_title(panel.title, loc="left", fontsize=9)
    axes.grid(visible=True, which="major", alpha=0.3)
    handles, names = axes.get_legend_handles_labels()
    once = {name: handle for handle, name in zip(reversed(handles), reversed(names), strict=True)}
    axes.legend(
        [*reversed(once.values())],
        [*reversed(once)],
        loc="upper center",
        bbox_to_anchor=(0.5, -0.13),
        ncols=2,
        fontsize=8,
        frameon=False,
    )


def _line(axes: Axes, curve: Curve, floor_m: float, order: int, *, largest: bool) -> None:
    marker = "o" if len(curve.count) <= _FEW and not curve.thin else None
    above = [1e3 * max(value, floor_m) for value in curve.mean]
    width = 0.6 if curve.thin else 2.0
    look = {"color": curve.colour, "zorder": 2 + order}
    axes.plot(
        curve.count, above, linestyle=curve.style, lw=width, marker=marker, markersize=4, label=curve.name, **look
    )
    if largest and curve.largest:
        above = [1e3 * max(value, floor_m) for value in curve.largest]
        axes.plot(curve.count, above, lw=1, linestyle=":", **look)
