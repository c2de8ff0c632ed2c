"""Present fixes that are not the marker."""

from __future__ import annotations

import numpy as np

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals, ResidualSettings
from bodyschema.diagnosis.report.svg_plot import Plot, span

from .presenter import FoundCause, Presenter, Workshop


class Outliers(Presenter):
    """Presenter of fixes that are not the marker."""

    effect = "outliers"
    noun = "fixes that are not the marker"

    def finding(self, found: FoundCause) -> str:
        return f"{100 * found.numbers['share']:.2g} % of the fixes are not the marker"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        share = f"{100 * found.numbers['share']:.2g} %"
        if workshop.robot.calibration is None:
            return (
                f"Look for what else was measured in {share} of the fixes, or was in the way. They were left out here."
            )
        return (
            f"Look at the images of the {share} of fixes that are not the marker: cover what else looks like it, and "
            "keep people out of the view. They were left out here."
        )


def outlier_panel(residuals: Residuals) -> Panel:
    length = 1e3 * np.linalg.norm(residuals.after, axis=1)
    away = np.flatnonzero(~residuals.diagnosis.markers)
    plot = Plot(residuals.clock_label, "error [mm]", span(residuals.clock), (0.0, 1.05 * float(length.max())))
    most = ResidualSettings.points
    parts = [(residuals.some(most), "pale after"), (residuals.some(most, away), "away")]
    marks = [plot.dots(residuals.clock[rows], length[rows], look) for rows, look in parts]
    return Panel("Fixes that are not the marker, beside those that are", plot.svg(*marks))
