"""Print a calibration report on a terminal of 80 columns."""

from __future__ import annotations

from rich.console import Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bodyschema.calibration.report import CalibrationReport, Figure, Zero
from bodyschema.cli.terminal.screen import ruled_table, such_zeros


class _Settings:
    misfit: float = 1.5  # told noise that explains the residuals leaves less than this
    # If held-out errors exceed those with free links by this factor, the URDF is measurably wrong. Chance on 5 blocks
    # of a good arm stays below 1.1.
    wrong_urdf: float = 1.25


def view(report: CalibrationReport) -> Group:
    """Return tables of the figures, followed by sentences on their meaning."""
    table = ruled_table(f"{report.robot}, {report.pairs} samples of {report.source}", "nominal", "learnt", "95 %")
    _section(table, f"camera on {report.camera_link}")
    _figures(table, ("x [mm]", "y [mm]", "z [mm]"), report.camera_xyz_mm, 2)
    _figures(table, ("roll [°]", "pitch [°]", "yaw [°]"), report.camera_rpy_deg, 3)
    _section(table, f"marker on {report.marker_link} (tool centre point)")
    _figures(table, ("x [mm]", "y [mm]", "z [mm]"), report.marker_xyz_mm, 2)
    _section(table, "joint zeros, to be added to the readings")
    for zero in report.zeros:
        table.add_row(Text(f"  {zero.joint} [{zero.unit}]"), "", *_zero(zero))
    return Group(table, *(Padding(Text(sentence), (1, 0, 0, 0), expand=False) for sentence in sentences(report)))


def sentences(report: CalibrationReport) -> list[str]:
    lines = [_expected(report)] if report.expected_mm is not None else []
    lines += [
        f"Mean distance to the samples: {_distances(report)}. {_noise(report)} {_outliers(report)}",
        _workmanship(report),
    ]
    if report.trusted == "nothing":
        lines.append(f"{report.shown} of {report.showable} identifiable parameters were determined." + _advice(report))
    hidden = [zero.joint for zero in report.zeros if zero.half_width is None]
    if hidden and report.trusted != "urdf":
        lines.append(
            f"Kept at nominal: {', '.join(hidden)}. The measurements cannot separate {such_zeros(hidden)} from a "
            "rotation of the camera, the marker or a neighbouring joint. Predicted positions are unaffected. "
            "The other figures are given that."
        )
    if report.undirected:
        lines.append(
            f"These samples do not show which way {', '.join(report.undirected)} "
            f"count{'s' if len(report.undirected) == 1 else ''}: the positions are the same either way."
        )
    if report.first > 1:
        lines.insert(0, f"Learnt from row {report.first} on.")
    if report.other_tool_from is not None:
        lines.insert(0, two_tools(report))
    if report.misfit > _Settings.misfit:
        lines.append(
            f"The residuals are {report.misfit:.1f} times what the noise explains: the arm is not quite a rigid chain "
            "(compliance, eccentric encoders), or the noise is larger than stated. The intervals are widened."
        )
    if report.doubt is not None:
        lines.insert(0, report.doubt)
    return lines


def two_tools(report: CalibrationReport) -> str:
    """Return advice for a recording made with two different tools."""
    return (
        f"From number {report.other_tool_from} on the marker sits about {report.other_tool_mm:.0f} mm elsewhere on "
        f"{report.marker_link}: these are samples of two tools, and no figure is right for both. Calibrate them "
        "separately: "
        f"--first {report.other_tool_from}, or --last {(report.other_tool_from or 0) - 1}."
    )


def _distances(report: CalibrationReport) -> str:
    if report.trusted == "urdf":
        return f"{report.learnt_error_mm:.3f} mm"
    return (
        f"{report.drawn_error_mm:.3f} mm for the nominal arm, best placed, {report.learnt_error_mm:.3f} mm for the "
        "learnt one"
    )


def _noise(report: CalibrationReport) -> str:
    cause = "Noise" if report.trusted == "nothing" else "Noise and errors of the URDF"
    scatter = f"{cause} in a coordinate, as the samples scatter: {report.noise_mm:.3f} mm"
    if report.told_noise_mm is None:
        return f"{scatter}."
    return f"{scatter}; as stated with them: {report.told_noise_mm:.3f} mm, on which the intervals rest."


def _expected(report: CalibrationReport) -> str:
    return (
        f"Expect {report.expected_mm:.2g} mm on new poses, 95 % ≤ {report.expected_p95_mm:.2g} mm: predicted from the "
        "other blocks of the recording, noise included."
    )


def _trusted(report: CalibrationReport) -> str:
    what = "Links and zeros are" if report.trusted == "urdf" else "The links are"
    lines = f"{what} those of the URDF; the intervals hold if it is right."
    free, expected = report.free_expected_mm, report.expected_mm
    if free is None or expected is None or expected < _Settings.wrong_urdf * free:
        return lines
    return f"{lines} The recording says it is not: with nothing held, expect {free:.2g} mm on new poses."


def _workmanship(report: CalibrationReport) -> str:
    if report.trusted != "nothing":
        return _trusted(report)
    if report.axes_deg is None or report.points_mm is None:
        return "These samples do not show how accurately the arm is made; the intervals hold for any accuracy."
    return (
        f"Estimated deviation from the URDF (1 sigma): axis directions {report.axes_deg:.2g}°, axis positions "
        f"{report.points_mm:.2g} mm."
    )


def _advice(report: CalibrationReport) -> str:
    if report.still:
        return f" Hardly moved: {', '.join(report.still)}. Move them, to determine more."
    if report.shown < report.showable:
        return " If axes stay parallel, or the marker is on one, the others do not matter; else move more joints."
    return ""


def _outliers(report: CalibrationReport) -> str:
    if report.outliers == 0:
        return "No outliers."
    return f"{report.outliers} outlier{'s' if report.outliers > 1 else ''} left out."


def _section(table: Table, title: str) -> None:
    table.add_row(Text(title, style="bold"), "", "", "")


def _figures(table: Table, names: tuple[str, ...], figures: list[Figure], digits: int) -> None:
    for name, figure in zip(names, figures, strict=True):
        table.add_row(
            Text(f"  {name}"),
            _fixed(figure.drawn, digits),
            _fixed(figure.learnt, digits),
            f"± {figure.half_width:.{digits}f}",
        )


def _fixed(value: float, digits: int) -> str:
    """Format with fixed digits, without a minus sign before zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _zero(zero: Zero) -> tuple[str, str]:
    if zero.half_width is None:
        return "nominal", "–"
    return f"{zero.zero:+.3f}", f"± {zero.half_width:.3f}"
