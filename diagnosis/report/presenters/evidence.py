"""Plot the evidence for a cause: residuals with all other causes removed, and the fitted effect."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals, ResidualSettings, binned
from bodyschema.diagnosis.report.svg_plot import Layout, Plot, span
from bodyschema.effects import Effect, Motion
from bodyschema.effects.encoder import EncoderEffect
from bodyschema.effects.moments import after
from bodyschema.interfaces.records import FloatArray


class _Settings:
    fine_points = 500
    many_cycles = 4.0  # a ripple with more cycles is plotted over its phase


def attributed(residuals: Residuals, effect: Effect) -> tuple[FloatArray, FloatArray]:
    """Return the residuals (n, 3) [m] with all other causes removed, and the effect's share of them."""
    own = residuals.contribution(effect)
    return residuals.after + own, own


def scatter_plot(
    residuals: Residuals,
    rows: NDArray[np.intp],
    points: tuple[FloatArray, FloatArray],
    curve: tuple[FloatArray, FloatArray],
    title: str,
    axes: tuple[str, str],
) -> Panel:
    x, y = points
    some = residuals.some(ResidualSettings.points, rows)
    bins = binned(x[rows], y[rows])
    low, high = np.quantile(y[rows], [Layout.cut, 1.0 - Layout.cut])
    plot = Plot(*axes, span(x[rows]), span(np.array([low, high]), curve[1]))
    marks = (
        plot.dots(x[some], y[some], "pale after"),
        plot.line(*curve, "fit"),
        plot.bars(bins.x, bins.y, bins.half, "after"),
    )
    return Panel(title, plot.svg(*marks))


def over_reading(residuals: Residuals, effect: Effect) -> Panel:
    """Plot a correction that is a function of one joint's reading."""
    place = residuals.run.simulation.place(effect)
    k = place.joint
    over = k if place.source is None else place.source
    partial, _ = attributed(residuals, effect)
    rows, factor = residuals.rows_moved_by(k), residuals.unit(k)[0]
    q = np.zeros((_Settings.fine_points, len(residuals.robot.joints)))
    q[:, over] = np.linspace(*_ends(residuals.motion.q[rows, over]), _Settings.fine_points)
    assert isinstance(effect.kind, EncoderEffect)
    motion = Motion(q, None, np.zeros(len(q), np.int64))
    fitted = factor * effect.kind.correction(motion, place, effect.values)
    x, fine = residuals.angles(over), q[:, over] * residuals.unit(over)[0]
    label = f"{residuals.robot.joints[over]} [{residuals.unit(over)[1]}]"
    curve = (fine, fitted)
    if (cycles := _cycles(effect)) is not None and cycles * float(np.ptp(q[:, over])) > _Settings.many_cycles:
        x = np.degrees(cycles * residuals.motion.q[:, over] * 2.0 * np.pi) % 360.0
        phase = np.linspace(0.0, 2.0 * np.pi, _Settings.fine_points)
        curve = (np.degrees(phase), factor * (effect.values[0] * np.sin(phase) + effect.values[1] * np.cos(phase)))
        label = f"phase of the ripple at {effect.where} [°]"
    title = f"How far {effect.where} is from its reading"
    axes = (label, f"{effect.where}: true less read [{residuals.unit(k)[1]}]")
    return scatter_plot(residuals, rows, (x, residuals.as_angle(k, partial)), curve, title, axes)


def _cycles(effect: Effect) -> float | None:
    """Return the cycles of a ripple per radian or metre; None for other effects."""
    if not effect.kind.is_periodic:
        return None
    return float(effect.values[2]) / (1.0 if effect.prismatic else 2.0 * np.pi)


def over_quantity(residuals: Residuals, effect: Effect, x: FloatArray, label: str, correction: FloatArray) -> Panel:
    """Plot a joint's error over a quantity that is not a reading, with the fitted correction (n,) [rad, m]."""
    k = residuals.run.simulation.place(effect).joint
    factor, unit = residuals.unit(k)
    partial, _ = attributed(residuals, effect)
    rows = residuals.rows_moved_by(k)
    order = rows[np.argsort(x[rows], kind="stable")]
    curve = (x[order], factor * correction[order])
    axes = (label, f"{effect.where}: true less read [{unit}]")
    title = f"How far {effect.where} is from its reading"
    return scatter_plot(residuals, rows, (x, residuals.as_angle(k, partial)), curve, title, axes)


def load(residuals: Residuals, effect: Effect) -> tuple[FloatArray, str]:
    """Return gravity's load (n,) on an effect's joint [N·m, N], with a label."""
    k = residuals.run.simulation.place(effect).joint
    return residuals.run.torques[:, k], f"gravity on {effect.where} [{'N' if residuals.slides(k) else 'N·m'}]"


def remembered(residuals: Residuals, effect: Effect) -> FloatArray:
    """Return the correction (n,) of an effect that depends on the order of the readings."""
    assert isinstance(effect.kind, EncoderEffect)
    place = residuals.run.simulation.place(effect)
    return effect.kind.correction(residuals.run.readings, place, effect.values)


def over_time_since(residuals: Residuals, effect: Effect) -> Panel:
    begins = float(residuals.clock[0]) - 1.0
    always = residuals.contribution_with(effect, np.append(effect.values[:-1], begins))
    partial, _ = attributed(residuals, effect)
    size = np.linalg.norm(always, axis=1)
    y = 1e3 * residuals.projected_amount(always, partial) * size
    fitted = 1e3 * size * after(residuals.motion, effect)
    rows = residuals.rows
    curve = (residuals.clock[rows], fitted[rows])
    title = f"{effect.name}: displacement over time, along the way it goes"
    return scatter_plot(residuals, rows, (residuals.clock, y), curve, title, (residuals.clock_label, "displaced [mm]"))


def by_distance(residuals: Residuals, effect: Effect) -> Panel:
    """Plot along the line of sight, over the distance."""
    partial, own = attributed(residuals, effect)
    x = residuals.diagnosis.extended.observations.x
    distance = np.linalg.norm(x, axis=1)
    y, fitted = (1e3 * np.einsum("ni,ni->n", x, e) / distance for e in (partial, own))
    rows = residuals.rows
    order = rows[np.argsort(distance[rows])]
    axes = ("distance from the camera [m]", "too far away [mm]")
    title = "Along the line of sight, over the distance"
    return scatter_plot(residuals, rows, (distance, y), (distance[order], fitted[order]), title, axes)


def measured_against_predicted(residuals: Residuals, effect: Effect) -> Panel:
    """Plot coordinates of the measured displacements over those that the effect predicts."""
    partial, own = attributed(residuals, effect)
    x, y = 1e3 * own.ravel(), 1e3 * partial.ravel()
    rows = (3 * residuals.rows[:, None] + np.arange(3)).ravel()
    ends = np.array(_ends(x[rows]))
    what = effect.name if effect.where is None else f"{effect.name} at {effect.where}"
    title = f"Displacements that {what} predicts, and those measured (each coordinate; line: as predicted)"
    return scatter_plot(residuals, rows, (x, y), (ends, ends), title, ("predicted [mm]", "measured [mm]"))


def _ends(values: FloatArray) -> tuple[float, float]:
    return float(values.min()), float(values.max())
