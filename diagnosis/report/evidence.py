"""Plot the evidence for each cause: residuals with all other causes removed, and the fitted effect."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bodyschema.effects import Effect, Motion
from bodyschema.effects.flank import flanks
from bodyschema.effects.moments import after
from bodyschema.interfaces.records import FloatArray

from .panels import Panel
from .plot import Plot, span
from .residuals import POINTS, Residuals, binned

_CUT = 0.01
_FINE = 500
# A ripple with more cycles is plotted over its phase.
_MANY_CYCLES = 4.0


def evidence_panels(residuals: Residuals, effect: Effect) -> list[Panel]:
    """Return the plots of one cause."""
    return [_BY_EFFECT.get(effect.name, _measured_against_predicted)(residuals, effect)]


def outlier_panel(residuals: Residuals) -> Panel:
    """Plot outliers beside the other fixes, over time."""
    length = 1e3 * np.linalg.norm(residuals.after, axis=1)
    away = np.flatnonzero(~residuals.diagnosis.markers)
    plot = Plot(residuals.clock_label, "error [mm]", span(residuals.clock), (0.0, 1.05 * float(length.max())))
    parts = [(residuals.some(POINTS), "pale after"), (residuals.some(POINTS, away), "away")]
    marks = [plot.dots(residuals.clock[rows], length[rows], look) for rows, look in parts]
    return Panel("Fixes that are not the marker, beside those that are", plot.svg(*marks))


def _partial(residuals: Residuals, effect: Effect) -> tuple[FloatArray, FloatArray]:
    """Return the residuals (n, 3) [m] with all other causes removed, and the effect's share of them."""
    own = residuals.contribution(effect)
    return residuals.after + own, own


def _drawn(
    residuals: Residuals,
    rows: NDArray[np.intp],
    points: tuple[FloatArray, FloatArray],
    curve: tuple[FloatArray, FloatArray],
    title: str,
    axes: tuple[str, str],
) -> Panel:
    """Plot single samples, their means, and the fitted curve."""
    x, y = points
    some = residuals.some(POINTS, rows)
    bins = binned(x[rows], y[rows])
    low, high = np.quantile(y[rows], [_CUT, 1.0 - _CUT])
    plot = Plot(*axes, span(x[rows]), span(np.array([low, high]), curve[1]))
    marks = (
        plot.dots(x[some], y[some], "pale after"),
        plot.line(*curve, "fit"),
        plot.bars(bins.x, bins.y, bins.half, "after"),
    )
    return Panel(title, plot.svg(*marks))


def _of_encoder(residuals: Residuals, effect: Effect) -> Panel:
    """Plot a correction that is a function of one joint's reading."""
    place = residuals.run.simulation.place(effect)
    k = place.joint
    over = k if place.source is None else place.source
    partial, _ = _partial(residuals, effect)
    rows, factor = residuals.telling(k), residuals.unit(k)[0]
    q = np.zeros((_FINE, len(residuals.robot.joints)))
    q[:, over] = np.linspace(*_ends(residuals.motion.q[rows, over]), _FINE)
    assert effect.kind.encoder is not None
    fitted = factor * effect.kind.encoder.correction(Motion(q, None, np.zeros(_FINE, np.int64)), place, effect.values)
    x, fine = residuals.angles(over), q[:, over] * residuals.unit(over)[0]
    label = f"{residuals.robot.joints[over]} [{residuals.unit(over)[1]}]"
    curve = (fine, fitted)
    if (cycles := _cycles(effect)) is not None and cycles * float(np.ptp(q[:, over])) > _MANY_CYCLES:
        x = np.degrees(cycles * residuals.motion.q[:, over] * 2.0 * np.pi) % 360.0
        phase = np.linspace(0.0, 2.0 * np.pi, _FINE)
        curve = (np.degrees(phase), factor * (effect.values[0] * np.sin(phase) + effect.values[1] * np.cos(phase)))
        label = f"phase of the ripple at {effect.where} [°]"
    title = f"How far {effect.where} is from its reading"
    axes = (label, f"{effect.where}: true less read [{residuals.unit(k)[1]}]")
    return _drawn(residuals, rows, (x, residuals.as_angle(k, partial)), curve, title, axes)


def _cycles(effect: Effect) -> float | None:
    """Return the cycles of a ripple per radian or metre; None for other effects."""
    if not effect.kind.is_periodic:
        return None
    return float(effect.values[2]) / (1.0 if effect.prismatic else 2.0 * np.pi)


def _over(residuals: Residuals, effect: Effect, x: FloatArray, label: str, correction: FloatArray) -> Panel:
    """Plot a joint's error over a quantity that is not a reading, with the fitted correction (n,) [rad, m]."""
    k = residuals.run.simulation.place(effect).joint
    factor, unit = residuals.unit(k)
    partial, _ = _partial(residuals, effect)
    rows = residuals.telling(k)
    order = rows[np.argsort(x[rows], kind="stable")]
    curve = (x[order], factor * correction[order])
    axes = (label, f"{effect.where}: true less read [{unit}]")
    title = f"How far {effect.where} is from its reading"
    return _drawn(residuals, rows, (x, residuals.as_angle(k, partial)), curve, title, axes)


def _remembered(residuals: Residuals, effect: Effect) -> FloatArray:
    """Return the correction (n,) of an effect that depends on the order of the readings."""
    assert effect.kind.encoder is not None
    place = residuals.run.simulation.place(effect)
    return effect.kind.encoder.correction(residuals.run.readings, place, effect.values)


def _jump(residuals: Residuals, effect: Effect) -> Panel:
    correction = _remembered(residuals, effect)
    return _over(residuals, effect, residuals.clock, residuals.clock_label, correction)


def _settling(residuals: Residuals, effect: Effect) -> Panel:
    k = residuals.run.simulation.place(effect).joint
    factor, unit = residuals.unit(k)
    label = f"last move of {effect.where} [{unit}]"
    return _over(residuals, effect, factor * residuals.motion.moves[:, k], label, _remembered(residuals, effect))


def _hysteresis(residuals: Residuals, effect: Effect) -> Panel:
    """Plot over the strain of the friction."""
    correction = _remembered(residuals, effect)
    strained = -correction / max(float(effect.values[0]), 1e-12)
    return _over(residuals, effect, strained, f"direction of the last moves of {effect.where}", correction)


def _compliance(residuals: Residuals, effect: Effect) -> Panel:
    k = residuals.run.simulation.place(effect).joint
    torque = residuals.run.torques[:, k]
    label = f"gravity on {effect.where} [{'N' if residuals.slides(k) else 'N·m'}]"
    return _over(residuals, effect, torque, label, effect.values[0] * torque)


def _gravity_backlash(residuals: Residuals, effect: Effect) -> Panel:
    k = residuals.run.simulation.place(effect).joint
    torque = residuals.run.torques[:, k]
    label = f"gravity on {effect.where} [{'N' if residuals.slides(k) else 'N·m'}]"
    side = flanks(torque, float(effect.values[1]))
    return _over(residuals, effect, torque, label, 0.5 * effect.values[0] * side)


def _backlash(residuals: Residuals, effect: Effect) -> Panel:
    """Plot both directions of motion separately."""
    k = residuals.run.simulation.place(effect).joint
    partial, _ = _partial(residuals, effect)
    rows, x, y = residuals.telling(k), residuals.angles(k), residuals.as_angle(k, partial)
    half = 0.5 * residuals.unit(k)[0] * float(effect.values[0])
    plot = Plot(
        f"{effect.where} [{residuals.unit(k)[1]}]",
        f"{effect.where}: true less read [{residuals.unit(k)[1]}]",
        span(x[rows]),
        span(y[rows], cut=_CUT),
    )
    marks = []
    ends = np.array(plot.x)
    for way, look in ((1, "up"), (-1, "down")):
        moving = rows[residuals.direction[rows, k] == way]
        if not len(moving):
            continue
        some, bins = residuals.some(POINTS // 2, moving), binned(x[moving], y[moving])
        marks.append(plot.dots(x[some], y[some], f"pale {look}"))
        marks.append(plot.line(ends, np.full(2, -way * half), f"fit {look}"))
        marks.append(plot.bars(bins.x, bins.y, bins.half, look))
    title = (
        f"How far {effect.where} is from its reading, moving up (blue) and down (orange); lines: half the play each way"
    )
    return Panel(title, plot.svg(*marks))


def _since(residuals: Residuals, effect: Effect) -> Panel:
    """Plot the displacement along a jump, over time."""
    begins = float(residuals.clock[0]) - 1.0
    always = residuals.instead(effect, np.append(effect.values[:-1], begins))
    partial, _ = _partial(residuals, effect)
    size = np.linalg.norm(always, axis=1)
    y = 1e3 * residuals.amount(always, partial) * size
    fitted = 1e3 * size * after(residuals.motion, effect)
    rows = residuals.rows
    curve = (residuals.clock[rows], fitted[rows])
    title = f"{effect.name}: displacement over time, along the way it goes"
    return _drawn(residuals, rows, (residuals.clock, y), curve, title, (residuals.clock_label, "displaced [mm]"))


def _drift(residuals: Residuals, effect: Effect) -> Panel:
    partial, own = _partial(residuals, effect)
    way = effect.values[:3] / max(float(np.linalg.norm(effect.values[:3])), 1e-12)
    rows = residuals.rows
    curve = (residuals.clock[rows], 1e3 * (own @ way)[rows])
    axes = (residuals.clock_label, "drifted [mm]")
    return _drawn(residuals, rows, (residuals.clock, 1e3 * partial @ way), curve, "Drift over time", axes)


def _latency(residuals: Residuals, effect: Effect) -> Panel:
    partial, own = _partial(residuals, effect)
    velocity = -residuals.run.columns(effect)[:, :, 0]
    speed = np.linalg.norm(velocity, axis=1)
    y, fitted = (1e3 * speed * residuals.amount(velocity, e) for e in (partial, own))
    rows, x = residuals.rows, 1e3 * speed
    slope = float(x[rows] @ fitted[rows]) / max(float(x[rows] @ x[rows]), 1e-12)
    ends = np.array([0.0, x[rows].max()])
    axes = ("speed of the marker [mm/s]", "ahead of the simulation [mm]")
    return _drawn(residuals, rows, (x, y), (ends, slope * ends), "Along the way of motion, over speed", axes)


def _by_distance(residuals: Residuals, effect: Effect) -> Panel:
    """Plot along the line of sight, over the distance."""
    partial, own = _partial(residuals, effect)
    x = residuals.diagnosis.extended.observations.x
    distance = np.linalg.norm(x, axis=1)
    y, fitted = (1e3 * np.einsum("ni,ni->n", x, e) / distance for e in (partial, own))
    rows = residuals.rows
    order = rows[np.argsort(distance[rows])]
    axes = ("distance from the camera [m]", "too far away [mm]")
    title = "Along the line of sight, over the distance"
    return _drawn(residuals, rows, (distance, y), (distance[order], fitted[order]), title, axes)


def _by_radius(residuals: Residuals, effect: Effect) -> Panel:
    """Plot radially in the image, over the distance from its centre."""
    assert residuals.calibration is not None
    partial, own = _partial(residuals, effect)
    x = residuals.diagnosis.extended.observations.x
    at = residuals.pixels(x)
    out = at - np.array(residuals.calibration.principal_point_px)
    radius = np.linalg.norm(out, axis=1)
    y, fitted = (
        np.einsum("ni,ni->n", out, at - residuals.pixels(x - e)) / np.maximum(radius, 1e-9) for e in (partial, own)
    )
    rows = residuals.rows
    order = rows[np.argsort(radius[rows])]
    curve = binned(radius[order], fitted[order])
    axes = ("distance from the image's middle [px]", "seen too far out [px]")
    return _drawn(residuals, rows, (radius, y), (curve.x, curve.y), "Outwards in the left image", axes)


def _measured_against_predicted(residuals: Residuals, effect: Effect) -> Panel:
    """Plot coordinates of the measured displacements over those that the effect predicts."""
    partial, own = _partial(residuals, effect)
    x, y = 1e3 * own.ravel(), 1e3 * partial.ravel()
    rows = (3 * residuals.rows[:, None] + np.arange(3)).ravel()
    ends = np.array(_ends(x[rows]))
    what = effect.name if effect.where is None else f"{effect.name} at {effect.where}"
    title = f"Displacements that {what} predicts, and those measured (each coordinate; line: as predicted)"
    return _drawn(residuals, rows, (x, y), (ends, ends), title, ("predicted [mm]", "measured [mm]"))


def _ends(values: FloatArray) -> tuple[float, float]:
    return float(values.min()), float(values.max())


_BY_EFFECT: dict[str, Callable[[Residuals, Effect], Panel]] = {
    "joint_offset": _of_encoder,
    "joint_scale": _of_encoder,
    "joint_eccentricity": _of_encoder,
    "joint_ripple": _of_encoder,
    "joint_coupling": _of_encoder,
    "encoder_jump": _jump,
    "backlash": _backlash,
    "settling": _settling,
    "hysteresis": _hysteresis,
    "joint_compliance": _compliance,
    "gravity_backlash": _gravity_backlash,
    "tool_slip": _since,
    "camera_moved": _since,
    "camera_scale": _by_distance,
    "camera_focal": _by_distance,
    "lens_distortion": _by_radius,
    "camera_latency": _latency,
    "thermal_drift": _drift,
}
