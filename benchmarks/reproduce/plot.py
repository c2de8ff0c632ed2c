"""Plot the figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .experiment import Curve, Experiment, Panel

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

# Curves with at most this many points get markers.
_FEW = 15
# A dash and a gap [points], the same for all widths, so that dashes of coinciding curves overlap.
_DASH = (9.0, 5.0)
# Number of intervals of the band for values that vary from pair to pair: these percentiles, and the median.
_STRETCHES = 70
_BAND = (10.0, 50.0, 90.0)
# Maximum number of points per decade of a logarithmic axis; points are averaged.
_A_DECADE = 15
# Errors above this are labelled with plain numbers, smaller ones with powers of ten [mm].
_PLAIN_MM = 1e-3


def plot(experiment: Experiment, file: Path) -> None:
    """Plot the panels side by side as a PNG: thick lines are mean errors, dotted ones the largest, as in the paper."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = experiment.panels
    figure = Figure(figsize=(6.5 * len(panels), 5.8), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(experiment.title, fontsize=11)
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        draw(axes, panel, experiment.floor_m)
        axes.set_xlabel(experiment.counted)
    figure.savefig(file, dpi=100, pil_kwargs={"optimize": True})


def draw(axes: Axes, panel: Panel, floor_m: float) -> None:
    """Plot one panel; lengths below the floor [m] are plotted on it."""
    axes.set_yscale("log")
    bands, curves = ([curve for curve in panel.curves if curve.thin is thin] for thin in (True, False))
    for curve in bands:
        _band(axes, curve, floor_m)
    for curve in curves:
        _line(axes, curve, floor_m, as_paper=panel.as_paper)
    _scales(axes, logarithmic_counts=not panel.as_paper)
    if any(mean < floor_m for curve in panel.curves for mean in curve.mean):
        _floor(axes, 1e3 * floor_m)
    axes.set_ylabel("error [mm]" if panel.as_paper else "mean error [mm]")
    axes.set_title(panel.title, loc="left", fontsize=9)
    axes.grid(visible=True, which="major", alpha=0.3)
    _legend(axes, panel)


def _line(axes: Axes, curve: Curve, floor_m: float, *, as_paper: bool) -> None:
    """Plot narrow lines above wide ones, so that coinciding lines all remain visible."""
    counts, means = np.array(curve.count), 1e3 * np.maximum(curve.mean, floor_m)
    if not as_paper:
        counts, means = _thinned(counts[counts > 0], means[counts > 0])
    marker = "o" if 2 < len(counts) <= _FEW else None
    style = (0.0, tuple(length / curve.width for length in _DASH)) if curve.style == "--" else curve.style
    look = {"color": curve.colour, "marker": marker, "markersize": curve.width + 2.5, "label": curve.name}
    axes.plot(counts, means, linestyle=style, lw=curve.width, zorder=3.0 - 0.1 * curve.width, **look)
    if as_paper and curve.largest:
        axes.plot(curve.count, 1e3 * np.maximum(curve.largest, floor_m), lw=1, linestyle=":", color=curve.colour)


def _band(axes: Axes, curve: Curve, floor_m: float) -> None:
    """Plot values that vary from pair to pair as a percentile band with its median."""
    stretches = np.array_split(np.arange(len(curve.count)), min(_STRETCHES, len(curve.count)))
    counts = [np.mean([curve.count[place] for place in stretch]) for stretch in stretches]
    lengths = 1e3 * np.maximum(curve.mean, floor_m)
    low, median, high = np.transpose([np.percentile(lengths[stretch], _BAND) for stretch in stretches])
    axes.fill_between(counts, low, high, color=curve.colour, alpha=0.25, lw=0)
    axes.plot(counts, median, color=curve.colour, lw=1.2, label=curve.name)


def _thinned(counts: FloatArray, means: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average points that are close on a logarithmic axis; keep the last one."""
    if len(counts) <= _FEW:
        return counts, means
    decades = np.round(_A_DECADE * np.log10(counts[:-1]))
    _, place, many = np.unique(decades, return_inverse=True, return_counts=True)
    few_counts, few_means = (np.bincount(place, values[:-1]) / many for values in (counts, means))
    return np.append(few_counts, counts[-1]), np.append(few_means, means[-1])


def _scales(axes: Axes, *, logarithmic_counts: bool) -> None:
    """Label counts and errors with plain numbers, unless they are rounding errors."""
    from matplotlib.ticker import LogLocator, NullFormatter

    if logarithmic_counts:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.tick_params(labelsize=9)
    low, high = axes.get_ylim()
    if low > _PLAIN_MM:
        axes.yaxis.set_major_formatter("{x:,g}")
    if high < 300.0 * low:
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _floor(axes: Axes, lowest_mm: float) -> None:
    """Draw the line of the plotted minimum, with a label below it."""
    axes.axhline(lowest_mm, color="grey", lw=0.6, zorder=0.0)
    axes.set_ylim(bottom=lowest_mm * (lowest_mm / axes.get_ylim()[1]) ** 0.07)
    where = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "ha": "right", "va": "top"}
    axes.annotate(f"≤ {lowest_mm:g} mm", (0.995, lowest_mm), (0, -5), fontsize=8, color="dimgrey", **where)


def _legend(axes: Axes, panel: Panel) -> None:
    """Put the legend below the plot: each name once, then the meaning of the styles."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    once: dict[str, Artist] = {}
    for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
        once.setdefault(str(name), handle)
    for curve in panel.curves:
        if curve.thin:
            once[curve.name] = Patch(facecolor=(curve.colour, 0.35), edgecolor=curve.colour, linewidth=1.2)
    if any(curve.thin for curve in panel.curves):
        once["band: 8 of 10 pairs; its line: the median"] = Patch(facecolor="lightgrey", edgecolor="dimgrey")
    for style, meaning in panel.styles.items():
        line = Line2D([], [], color="dimgrey", lw=1.5)
        line.set(linestyle=style)
        once[meaning] = line
    if panel.as_paper and any(curve.largest for curve in panel.curves):
        once["dotted: the largest error"] = Line2D([], [], color="dimgrey", linestyle=":", lw=1.0)
    look = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.13), "ncols": 2, "fontsize": 8, "frameon": False}
    axes.legend(list(once.values()), list(once), handlelength=3.0, **look)
