"""Plot errors before and after: against everything they may depend on, their sizes, and their directions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray

from .residuals import Residuals, ResidualSettings, binned, structure
from .svg_plot import ASPECT, Layout, Plot, round_up, span


@dataclass(frozen=True)
class Panel:
    """A plot with its title."""

    title: str  # description of the plot
    svg: str  # the plot
    explained_share: float = 1.0  # share of the variance before that depends on the plotted quantity

    @property
    def is_significant(self) -> bool:
        """True if the plot shows a clear dependence."""
        return self.explained_share >= Layout.min_explained_share

    def html(self) -> str:
        return f"<figure><figcaption>{escape(self.title)}</figcaption>{self.svg}</figure>"


def error_panels(residuals: Residuals) -> list[Panel]:
    """Return all panels, the most informative first; those over time come last, as they show moments."""
    found = [*_by_joint(residuals), *_by_torque(residuals), *_by_image(residuals)]
    direction = _by_direction(residuals)
    return [*sorted([*found, direction], key=lambda panel: -panel.explained_share), *_by_time(residuals)]


def _compared(
    residuals: Residuals, x: FloatArray, before: FloatArray, after: FloatArray, title: str, axes: tuple[str, str]
) -> Panel:
    """Plot single errors, pale, with their means and 95 % intervals, before and after."""
    rows = residuals.rows
    some = residuals.some(ResidualSettings.points)
    means = [(binned(x[rows], y[rows]), look) for y, look in ((before, "before"), (after, "after"))]
    plot = Plot(*axes, span(x[rows]), span(before[rows], after[rows], cut=Layout.cut, around_zero=True))
    marks = [plot.dots(x[some], before[some], "pale before"), plot.dots(x[some], after[some], "pale after")]
    marks += [plot.bars(bins.x, bins.y, bins.half, look) for bins, look in means]
    explained_share = max(structure(x[rows], y[rows]) for y in (before, after))
    return Panel(title, plot.svg(*marks), explained_share)


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
    by_sign: dict[str, list[tuple[float, float, float]]] = {"before": [], "after": []}
    explained_share = 0.0
    for look, errors in (("before", residuals.before), ("after", residuals.after)):
        for k in range(len(joints)):
            way, error = residuals.direction[rows, k], residuals.along(k, errors)[rows]
            up, down = error[way > 0], error[way < 0]
            if min(len(up), len(down)) < 2:
                continue
            half = 1.96 * float(np.sqrt(up.var(ddof=1) / len(up) + down.var(ddof=1) / len(down)))
            by_sign[look].append((k, float(up.mean() - down.mean()), half))
            explained_share = max(explained_share, structure(way.astype(np.float64), error))
    figures = {look: np.array(values).reshape(-1, 3) for look, values in by_sign.items()}
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
    return Panel(
        "Against the direction of motion: error moving up less error moving down", plot.svg(*marks), explained_share
    )


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
        yield Panel(panel.title, _with_moments(residuals, panel.svg), panel.explained_share)


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
    count = np.array(Layout.cells)
    cells = np.clip(((at - low) / (high - low) * count).astype(np.intp), 0, count - 1) @ (1, count[0])
    means = {look: _cell_means(cells, at, error) for look, error in errors.items()}
    longest = round_up(max(float(np.linalg.norm(m[:, 2:], axis=1).max(initial=1e-6)) for m in means.values()))
    stretch = float(high[0] - low[0]) / Layout.cells[0] / longest
    plot = Plot("u in the left image [px]", "v [px]", (low[0], high[0]), (high[1], low[1]))
    marks = [plot.arrows(m[:, 0], m[:, 1], stretch * m[:, 2], stretch * m[:, 3], look) for look, m in means.items()]
    explained_share = max(structure(at[:, i], error[:, j]) for error in errors.values() for i in (0, 1) for j in (0, 1))
    title = f"Over the image: mean errors; an arrow as long as a tenth of the width is {longest:.3g} px"
    yield Panel(title, plot.svg(*marks), explained_share)


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
        if rows.sum() >= Layout.min_in_a_cell
    ]
    return np.array(arrows).reshape(-1, 4)


def histogram(residuals: Residuals) -> Panel:
    """Plot lengths of the errors before and after, beside those of noise alone."""
    before, after = (1e3 * np.linalg.norm(e[residuals.rows], axis=1) for e in (residuals.before, residuals.after))
    noise = 1e3 * _noise(residuals)
    end = float(np.quantile(np.concatenate([before, after]), Layout.shown)) or 1.0
    columns = int(np.clip(len(before) // Layout.pairs_a_column, Layout.min_columns, Layout.max_columns))
    edges = np.linspace(0.0, end, columns + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    shares = {
        look: 100.0 * np.histogram(lengths, edges)[0] / len(lengths)
        for look, lengths in (("before", before), ("after", after), ("noise", noise))
    }
    top = max(float(share.max()) for share in shares.values())
    plot = Plot("error [mm]", "share of the samples [%]", (0.0, end), (0.0, 1.06 * top))
    marks = [plot.area(middle, shares[look], look) for look in ("before", "after")]
    return Panel(
        "How large the errors are: before, after, and what noise alone would be (line)",
        plot.svg(*marks, plot.line(middle, shares["noise"], "noise")),
    )


def _noise(residuals: Residuals) -> FloatArray:
    """Return lengths of errors due to noise alone."""
    fit = residuals.diagnosis.extended
    spread = np.linalg.inv(fit.observations.whitening[residuals.rows])
    rng = np.random.default_rng(residuals.diagnosis.seed)
    drawn = rng.normal(size=(Layout.drawn, len(spread), 3))
    return fit.noise.sigma * np.linalg.norm(np.einsum("nij,knj->kni", spread, drawn), axis=2).ravel()


def arrows(residuals: Residuals) -> tuple[list[Panel], float]:
    """Return three projections before and three after at the same scale, and the stretch of the arrows."""
    rows = residuals.some(ResidualSettings.arrows)
    at = residuals.diagnosis.extended.observations.x[rows]
    extent = float(np.ptp(at, axis=0).max()) or 1.0
    usual = float(np.quantile(np.linalg.norm(residuals.before[rows], axis=1), Layout.shorter)) or 1e-6
    stretch = max(round_up(Layout.long * extent / usual), 1.0)
    if residuals.calibration is not None:
        views = (("as the camera sees it", 0, 1, 1), ("from above the camera", 0, 2, -1), ("from its side", 2, 1, 1))
    else:
        views = (("x and y", 0, 1, -1), ("x and z", 0, 2, -1), ("y and z", 1, 2, -1))
    panels = [
        Panel(f"{when}: {name}", _projection(at, errors[rows], stretch, (across, down), sign, extent, look))
        for when, look, errors in (("Before", "before", residuals.before), ("After", "after", residuals.after))
        for name, across, down, sign in views
    ]
    return panels, stretch


def _projection(
    at: FloatArray, errors: FloatArray, stretch: float, axes: tuple[int, int], sign: int, extent: float, look: str
) -> str:
    """Draw arrows from the predicted to the measured marker position, stretched."""
    flip = np.array([1.0, sign])
    middle = 0.5 * (at.min(axis=0) + at.max(axis=0))
    scale = (Layout.side - 2 * Layout.margin) / extent
    feet = (at - errors - middle)[:, axes] * flip * scale + 0.5 * Layout.side
    ends = stretch * errors[:, axes] * flip * scale
    path = "".join(f"M{x:.1f} {y:.1f}l{dx:.1f} {dy:.1f}" for (x, y), (dx, dy) in zip(feet, ends, strict=True))
    dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in feet)
    bar = round_up(0.2 * extent)
    return (
        f'<svg viewBox="0 0 {Layout.side} {Layout.side}" role="img" aria-label="error arrows">'
        f'<path class="arrows {look}" d="{path}"/><path class="feet {look}" d="{dots}"/>'
        f'<path class="scale" d="M8 {Layout.side - 8}h{bar * scale:.1f}"/>'
        f'<text x="{14 + bar * scale:.1f}" y="{Layout.side - 4}">{100 * bar:.3g} cm</text></svg>'
    )
