"""Show calibration and outlook of the learner's status in a terminal of 80 columns."""

from __future__ import annotations

import math
from collections.abc import Collection

from rich.console import Group
from rich.table import Table
from rich.text import Text

from bodyschema.learning.status import ChainCalibration, DataOutlook, JointZero, LearntFigure

from .screen import mm, such_zeros


def outlook_lines(outlook: DataOutlook | None) -> list[str]:
    """Return at most two lines on the sufficiency of the data."""
    if outlook is None:
        return ["not known yet"]
    pairs = outlook.further_pairs[-1]
    like = f"{pairs} more samples like these take {_gain(outlook, outlook.like_so_far_m)} off the error beyond noise"
    return [
        f"{'yes' if outlook.enough else 'no'}: {like}",
        f"{pairs} of {outlook.best_motion}: {_gain(outlook, outlook.best_motion_m)}"
        if _other_is_better(outlook)
        else "no other motion gains more",
    ]


def outlook_sentence(outlook: DataOutlook) -> str:
    best = "no other motion gains more"
    if _other_is_better(outlook):
        best = f"{outlook.best_motion} gains most: {_gain(outlook, outlook.best_motion_m)}"
    return (
        f"{outlook.further_pairs[-1]} more samples like these would take {_gain(outlook, outlook.like_so_far_m)} off "
        f"the error beyond noise where the arm was; {best}. "
        f"{'Enough data.' if outlook.enough else 'More data would help.'}"
    )


def calibration_table(calibration: ChainCalibration, slides: Collection[str] = ()) -> Group:
    """Return a table of camera and tool pose and joint offsets, compared with robot.toml.

    Args:
        slides: names of the prismatic joints.
    """
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("")
    for name in ("x, roll", "y, pitch", "z, yaw"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_row(Text(f"camera on {calibration.camera_link} [mm]"), *_moves(calibration.camera_xyz, 1e3))
    table.add_row(Text("turned by [°]"), *_moves(calibration.camera_rpy, math.degrees(1.0)))
    table.add_row(Text(f"marker on {calibration.marker_link} [mm]"), *_moves(calibration.marker_xyz, 1e3))
    facts = Table.grid(padding=(0, 2))
    facts.add_column(no_wrap=True)
    shown = {name: zero for name, zero in calibration.zeros.items() if zero is not None}
    nominal = [name for name in calibration.zeros if name not in shown]
    if shown:
        zeros = ", ".join(f"{name} {_zero(zero, slides=name in slides)}" for name, zero in shown.items())
        facts.add_row("zeros to add", zeros)
    if nominal:
        facts.add_row("kept at nominal", f"{', '.join(nominal)}: no motion shows {such_zeros(nominal)}")
    facts.add_row("arm made to", _workmanship(calibration))
    facts.add_row("noise", f"{mm(calibration.noise_m)} a coordinate, {_outliers(calibration.outliers)}")
    return Group(
        Text(f"calibration: from robot.toml to what {calibration.pairs} samples show, ± for 95 %", style="bold"),
        table,
        facts,
    )


def _workmanship(calibration: ChainCalibration) -> str:
    if calibration.axes_rad is None or calibration.points_m is None:
        return "not determined by these samples"
    return f"about {math.degrees(calibration.axes_rad):.2g}° and {1e3 * calibration.points_m:.2g} mm"


def _other_is_better(outlook: DataOutlook) -> bool:
    return outlook.best_motion_m != outlook.like_so_far_m


def _gain(outlook: DataOutlook, after_m: list[float]) -> str:
    """Return the share of the error beyond noise that the largest number of further pairs would remove."""
    return f"{max(1.0 - after_m[-1] / outlook.error_m, 0.0):.0%}" if outlook.error_m else "0%"


def _outliers(count: int) -> str:
    return f"{count or 'no'} outlier{'' if count == 1 else 's'} among the last samples"


def _moves(figures: list[LearntFigure], unit: float) -> list[str]:
    return [_rounded(unit * (figure.learnt - figure.drawn), unit * figure.half_width) for figure in figures]


def _zero(zero: JointZero, *, slides: bool) -> str:
    unit, name = (1e3, " mm") if slides else (math.degrees(1.0), "°")
    return _rounded(unit * zero.value, unit * zero.half_width) + name


def _rounded(value: float, half_width: float) -> str:
    """Round to the place of the second digit of the half width."""
    digits = min(max(1 - math.floor(math.log10(max(half_width, 1e-9))), 0), 4)
    return f"{round(value, digits) + 0.0:+.{digits}f} ± {half_width:.{digits}f}"
