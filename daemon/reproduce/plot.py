"""The figures as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .experiment import Curve, Experiment, Panel

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

# Curves with so few points get markers.
_FEW = 15
# Line widths of a panel's first and last curve: where curves coincide, the earlier one shows beneath.
_WIDEST, _NARROWEST = 2.8, 1.2
_THIN = 0.5


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
    figure.savefig(file, dpi=100, pil_kwargs={"optimize": True})


def _draw(axes: Axes, panel: Panel, floor_m: float) -> None:
    lowest = 1e3 * floor_m
    curves = sorted(panel.curves, key=lambda curve: not curve.thin)
    widths = [2.0] * len(curves) if panel.as_paper else np.linspace(_WIDEST, _NARROWEST, len(curves)).tolist()
    for curve, width in zip(curves, widths, strict=True):
        _line(axes, curve, floor_m, width, as_paper=panel.as_paper)
    axes.set_yscale("log")
    if not panel.as_paper:
        axes.set_xscale("log")
    if any(mean < floor_m for curve in curves for mean in curve.mean):
        axes.axhline(lowest, color="grey", lw=0.6)
        where = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
        axes.annotate(f"below {lowest:g} mm", (1.0, lowest), fontsize=7, color="grey", **where)
    axes.set_ylabel("error [mm]; dotted: the largest" if panel.as_paper else "mean error [mm]")
    axes.set_title(panel.title, loc="left", fontsize=9)
    axes.grid(visible=True, which="major", alpha=0.3)
    _legend(axes)


def _line(axes: Axes, curve: Curve, floor_m: float, width: float, *, as_paper: bool) -> None:
    drawn = [place for place, count in enumerate(curve.count) if as_paper or count > 0]
    counts = [curve.count[place] for place in drawn]
    marker = "o" if 2 < len(counts) <= _FEW and not curve.thin else None
    look = {"color": curve.colour, "alpha": 0.7 if curve.thin else 1.0}
    above = [1e3 * max(curve.mean[place], floor_m) for place in drawn]
    width = _THIN if curve.thin else width
    axes.plot(counts, above, linestyle=curve.style, lw=width, marker=marker, markersize=4, label=curve.name, **look)
    if as_paper and curve.largest:
        axes.plot(counts, [1e3 * max(curve.largest[place], floor_m) for place in drawn], lw=1, linestyle=":", **look)


def _legend(axes: Axes) -> None:
    """Below the plot, each name once."""
    once: dict[str, Artist] = {}
    for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
        once.setdefault(str(name), handle)
    axes.legend(
        list(once.values()),
        list(once),
        loc="upper center",
        bbox_to_anchor=(0.5, -0.13),
        ncols=2,
        fontsize=8,
        frameon=False,
    )
