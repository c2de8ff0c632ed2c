"""Report of a replay, as JSON and as text."""

from __future__ import annotations

import math
import textwrap

import msgspec
import numpy as np

from bodyschema.calibration.evaluate import BLOCKS, ErrorFigures
from bodyschema.cli.terminal.findings_view import outlook_sentence
from bodyschema.cli.terminal.screen import mm
from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.status import DataOutlook


class Figures(msgspec.Struct, frozen=True):
    """Distances between prediction and measurement on the held-out rows [mm]."""

    mean_mm: float
    rms_mm: float
    median_mm: float
    p95_mm: float
    max_mm: float

    @classmethod
    def of(cls, figures: ErrorFigures) -> Figures:
        """Return the figures in mm."""
        metres = (figures.mean_m, figures.rms_m, figures.median_m, figures.p95_m, figures.max_m)
        return cls(*(1e3 * value for value in metres))


class AngleFigures(msgspec.Struct, frozen=True):
    """Angles between predicted and measured orientation on the held-out rows [°], and the learner's predicted error."""

    # mean_deg, median_deg, p95_deg: of the angles
    mean_deg: float
    median_deg: float
    p95_deg: float
    claimed_deg: float | None  # mean angle to the truth that the learner predicts in its support, or null

    @classmethod
    def of(cls, angles_rad: FloatArray, claimed_rad: float | None) -> AngleFigures:
        """Return the figures of angles (n,) [rad]."""
        mean, median, p95 = np.degrees(
            [angles_rad.mean(), np.median(angles_rad), np.quantile(angles_rad, 0.95)]
        ).tolist()
        return cls(mean, median, p95, None if claimed_rad is None else math.degrees(claimed_rad))


class ReplayReport(msgspec.Struct, frozen=True, kw_only=True):
    recording: str
    robot: str
    rows: int  # in the recording
    held_out: int  # of these, held-out rows, in `held_out_blocks` of 10 contiguous blocks
    held_out_blocks: int
    accepted: int  # pairs that the sampler made of the others; `rejected` by reason
    rejected: dict[str, int]
    any_step: bool  # True if the sampler's step and speed rules were relaxed
    steps: str
    fitted: list[str]  # what `before` fitted, as named in robot.toml
    before: Figures  # best alignment of what robot.toml declares unknown, fitted to the learnt rows
    after: Figures  # the learner's predictions, queried over zenoh
    answering: str  # the model that answered
    prequential_mm: dict[str, float]  # recent mean error on pairs before they were learnt, by model [mm]
    claimed_mm: float | None  # mean error to the truth that the learner predicts in its support [mm], or null
    expected_mm: float | None  # mean error on new pairs that it predicts, measurement noise included [mm], or null
    in_support_share: float  # share of held-out rows in the learner's support
    within_sigma_share: float  # share of held-out coordinates within 1-sigma of prediction and stated noise together
    doubted: int
    replayed: int  # replay steps of the instant learner
    outlook: DataOutlook | None  # gain that the learner expects of further pairs, or null
    doubt: str | None  # possible problems of the recording, or null: columns read wrongly, another robot
    learning_s: float  # time from the first pair to the end of learning [s]
    angle: AngleFigures | None = None  # of the marker's orientation; null if the recording has none
    schema: int = 1


def as_text(report: ReplayReport, width: int = 80) -> str:
    """Return the report for a terminal of `width` columns; figures in columns are not wrapped."""
    rejected = ", ".join(f"{count} {reason}" for reason, count in sorted(report.rejected.items())) or "none"
    fitted = f"the nominal model with {' and '.join(report.fitted)} fitted" if report.fitted else "the nominal model"
    by_model = ", ".join(f"{name} {value:.3f} mm" for name, value in report.prequential_mm.items())
    lines = [
        f"{report.rows} rows of {report.recording}; {report.held_out} held out "
        f"({report.held_out_blocks} of {BLOCKS} contiguous blocks)",
        f"the sampler accepted {report.accepted} samples; rejected: {rejected}",
    ]
    if report.any_step:
        lines.append(f"--any-step: the step and speed rules were relaxed; {report.steps}")
    lines += [
        "",
        "error on the held-out rows        mean         RMS      median        95 %",
        f"before: aligned          {_row(report.before)}",
        f"after: learnt            {_row(report.after)}",
        "",
        *([] if report.angle is None else [_angles(report.angle)]),
        f"before is {fitted} to the rows that were learnt; after is what the learner answers (model: "
        f"{report.answering}). {_verdict(report)}",
        f"error on new samples before they were learnt: {by_model or 'none'}",
        f"the errors above count the noise of the measurements; on new samples where data is the learner expects "
        f"{mm(_metres(report.expected_mm))}; its 1-sigma and that noise together cover "
        f"{report.within_sigma_share:.0%} of the held-out coordinates (68 % is right); "
        f"{report.in_support_share:.0%} of the held-out rows lie where data was",
        *([] if report.outlook is None else [outlook_sentence(report.outlook)]),
        f"{report.replayed} replay steps, {report.doubted} samples rejected as outliers, {report.learning_s:.1f} s",
        *([] if report.doubt is None else ["", f"Warning: {report.doubt}"]),
    ]
    return "\n".join(_wrapped(line, width) for line in lines)


def _angles(angle: AngleFigures) -> str:
    claim = "" if angle.claimed_deg is None else f"; the learner claims {angle.claimed_deg:.3f}° to the truth"
    return (
        f"orientation on the held-out rows: mean {angle.mean_deg:.3f}°, median {angle.median_deg:.3f}°, 95 % within "
        f"{angle.p95_deg:.3f}°{claim}"
    )


def _wrapped(line: str, width: int) -> str:
    if len(line) <= width or "   " in line:
        return line
    return textwrap.fill(line, width, break_long_words=False, break_on_hyphens=False)


def _row(figures: Figures) -> str:
    columns = (figures.mean_mm, figures.rms_mm, figures.median_mm, figures.p95_mm)
    return "".join(f"{value:9.3f} mm" for value in columns)


def _verdict(report: ReplayReport) -> str:
    ratio = report.after.mean_mm / report.before.mean_mm if report.before.mean_mm else 1.0
    if abs(ratio - 1.0) < 0.01:
        return "Learning left the mean error as it was."
    return f"Learning {'lowered' if ratio < 1 else 'raised'} the mean error to {ratio:.0%}."


def _metres(value_mm: float | None) -> float | None:
    return None if value_mm is None else 1e-3 * value_mm
