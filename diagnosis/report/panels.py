"""Plot errors before and after against everything they may depend on, the most informative first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

from .plot import ASPECT, Plot, round_up, span
from .residuals import POINTS, Residuals, binned, structure

# Share of the error variance that a plot must explain to be shown at first.
_TELLING = 0.02
# Share of single errors at each end that does not set the range of a plot.
_CUT = 0.01
_CELLS = (10, 6)
_FEWEST_IN_A_CELL = 3
# Length of the longest mean arrow, as a share of a cell.
_OF_A_CELL = 1.0


@dataclass(frozen=True)
class Panel:
    """A plot with its title.

    Attributes:
        title: description of the plot.
        svg: the plot.
        tells: share of the variance before that depends on the plotted quantity.
    """

    title: str
    svg: str
    tells: float = 1.0

    @property
    def is_telling(self) -> bool:
        """True if the plot shows a clear dependence."""
        return self.tells >= _TELLING

    def html(self) -> str:
        """Return the plot with its title."""
        return f"<figure><figcaption>{escape(self.title)}</figcaption>{self.svg}</figure>"


def panels(residuals: Residuals) -> list[Panel]:
    """Return all panels, the most informative first; those over time come last, as they show moments."""
    found = [*_by_joint(residuals), *_by_torque(residuals), *_by_image(residuals)]
    direction = _by_direction(residuals)
    return [*sorted([*found, direction], key=lambda panel: -panel.tells), *_by_time(residuals)]


def _compared(
    residuals: Residuals, x: FloatArray, before: FloatArray, after: FloatArray, title: str, axes: tuple[str, str]
) -> Panel:
    """Plot single errors, pale, with their means and 95 % intervals, before and after."""
    rows = residuals.rows
    some = residuals.some(POINTS)
    means = [(binned(x[rows], y[rows]), look) for y, look in ((before, "before"), (after, "after"))]
    plot = Plot(*axes, span(x[rows]), span(before[rows], after[rows], cut=_CUT, around_zero=True))
    marks = [plot.dots(x[some], before[some], "pale before"), plot.dots(x[some], after[some], "pale after")]
    marks += [plot.bars(bins.x, bins.y, bins.half, look) for bins, look in means]
    tells = max(structure(x[rows], y[rows]) for y in (before, after))
    return Panel(title, plot.svg(*marks), tells)


def _by_joint(residuals: Residuals) -> Iterator[Panel]:
    for k, name in enumerate(residuals.robot.joints):
        if np.ptp(residuals.motion.q[:, k]) <= 0.0:
            continue
        before, after = residuals.along(k, residuals.before), residuals.along(k, residuals.after)
        axes = (f"{name} [{residuals.unit(k)[1]}]", f"error along {name} [mm]")
        yield _compared(residuals, residuals.angles(k), before, after, f"Against the angle of {name}", axes)


def _by_torque(residuals: Residuals) -> Iterator[Panel]:
    if not residuals.run.simulation.shows_weight:
        return
    for k, name in enumerate(residuals.robot.joints):
        torque = residuals.run.torques[:, k]
        if np.ptp(torque) <= 1e-6:
            continue
        before, after = residuals.along(k, residuals.before), residuals.along(k, residuals.after)
        axes = (f"gravity on {name} [{'N' if residuals.slides(k) else 'N·m'}]", f"error along {name} [mm]")
        yield _compared(residuals, torque, before, after, f"Against the weight on {name}", axes)


def _by_direction(residuals: Residuals) -> Panel:
    """Plot for each joint the distance between the means of both directions of motion."""
    joints, rows = residuals.robot.joints, residuals.rows
    apart: dict[str, list[tuple[float, float, float]]] = {"before": [], "after": []}
    tells = 0.0
    for look, errors in (("before", residuals.before), ("after", residuals.after)):
        for k in range(len(joints)):
            way, error = residuals.direction[rows, k], residuals.along(k, errors)[rows]
            up, down = error[way > 0], error[way < 0]
            if min(len(up), len(down)) < 2:
                continue
            half = 1.96 * float(np.sqrt(up.var(ddof=1) / len(up) + down.var(ddof=1) / len(down)))
            apart[look].append((k, float(up.mean() - down.mean()), half))
            tells = max(tells, structure(way.astype(np.float64), error))
    figures = {look: np.array(values).reshape(-1, 3) for look, values in apart.items()}
    everything = np.concatenate([np.abs(f[:, 1]) + f[:, 2] for f in figures.values()] or [np.ones(1)])
    plot = Plot(
        "joint",
        "up less down [mm]",
        (-0.6, len(joints) - 0.4),
        span(np.append(everything, 1e-3), around_zero=True),
        names=[name if len(name) * len(joints) < 46 else f"{k + 1}" for k, name in enumerate(joints)],
    )
    marks = [
        plot.bars(f[:, 0] + s, f[:, 1], f[:, 2], look)
        for (look, f), s in zip(figures.items(), (-0.1, 0.1), strict=True)
    ]
    return Panel("Against the direction of motion: error moving up less error moving down", plot.svg(*marks), tells)


def _by_time(residuals: Residuals) -> Iterator[Panel]:
    names = ("sideways (x)", "down (y)", "in depth (z)") if residuals.calibration else ("in x", "in y", "in z")
    for axis, name in enumerate(names):
        before, after = (1e3 * errors[:, axis] for errors in (residuals.before, residuals.after))
        panel = _compared(
            residuals,
            residuals.clock,
            before,
            after,
            f"Over time, {name}",
            (residuals.clock_label, f"error {name} [mm]"),
        )
        yield Panel(panel.title, _with_moments(residuals, panel.svg), panel.tells)


def _with_moments(residuals: Residuals, svg: str) -> str:
    rows = residuals.rows
    plot = Plot("", "", span(residuals.clock[rows]), (0.0, 1.0))
    moments = [
        plot.moment(effect.value("t0"), effect.name if effect.where is None else f"{effect.name} at {effect.where}")
        for effect in residuals.diagnosis.causes
        if effect.kind.begins
    ]
    return f"{svg.removesuffix('</svg>')}{''.join(moments)}</svg>"


def _by_image(residuals: Residuals) -> Iterator[Panel]:
    """Plot mean errors in cells over the image area that the marker covered."""
    if residuals.calibration is None:
        return
    x = residuals.diagnosis.extended.observations.x[residuals.rows]
    at = residuals.pixels(x)
    errors = {
        look: at - residuals.pixels(x - error[residuals.rows])
        for look, error in (("before", residuals.before), ("after", residuals.after))
    }
    low, high = _framed(at.min(axis=0), at.max(axis=0))
    cells = np.clip(((at - low) / (high - low) * _CELLS).astype(np.intp), 0, np.array(_CELLS) - 1) @ (1, _CELLS[0])
    means = {look: _cell_means(cells, at, error) for look, error in errors.items()}
    longest = round_up(max(float(np.linalg.norm(m[:, 2:], axis=1).max(initial=1e-6)) for m in means.values()))
    stretch = _OF_A_CELL * float(high[0] - low[0]) / _CELLS[0] / longest
    plot = Plot("u in the left image [px]", "v [px]", (low[0], high[0]), (high[1], low[1]))
    marks = [plot.arrows(m[:, 0], m[:, 1], stretch * m[:, 2], stretch * m[:, 3], look) for look, m in means.items()]
    tells = max(structure(at[:, i], error[:, j]) for error in errors.values() for i in (0, 1) for j in (0, 1))
    title = f"Over the image: mean errors; an arrow as long as a tenth of the width is {longest:.3g} px"
    yield Panel(title, plot.svg(*marks), tells)


def _framed(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return corners (2,) [px] of an area around points, with the same scale on both axes."""
    middle, size = 0.5 * (low + high), 1.08 * (high - low)
    size = np.maximum(size, [ASPECT * size[1], size[0] / ASPECT])
    return middle - 0.5 * size, middle + 0.5 * size


def _cell_means(cells: NDArray[np.intp], at: FloatArray, error: FloatArray) -> FloatArray:
    """Return centres of the cells and mean errors in them (c, 4) [px]."""
    inside = [cells == k for k in np.unique(cells)]
    arrows = [
        np.concatenate([at[rows].mean(axis=0), error[rows].mean(axis=0)])
        for rows in inside
        if rows.sum() >= _FEWEST_IN_A_CELL
    ]
    return np.array(arrows).reshape(-1, 4)
