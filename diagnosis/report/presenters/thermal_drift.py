"""Present a slow drift of the measurements."""

from __future__ import annotations

import math

import numpy as np

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals
from bodyschema.effects import Effect

from .evidence import attributed, scatter_plot
from .presenter import FoundCause, Presenter, Workshop


class ThermalDrift(Presenter):
    """Presenter of a slow drift of the measurements."""

    effect = "thermal_drift"
    noun = "a drift that settles"

    def finding(self, found: FoundCause) -> str:
        constant = f"{found.numbers['time_constant_s']:.0f} s"
        return f"what is measured drifts by {found.shift} with a time constant of {constant}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        over = 0.05  # remaining share at which a drift is over
        wait = -math.log(over) * found.numbers["time_constant_s"]
        return (
            f"Let camera and arm warm up for {_duration(wait)} before recording: {100 * over:.0f} % of the drift is "
            "left then."
        )

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        partial, own = attributed(residuals, effect)
        way = effect.values[:3] / max(float(np.linalg.norm(effect.values[:3])), 1e-12)
        rows = residuals.rows
        curve = (residuals.clock[rows], 1e3 * (own @ way)[rows])
        axes = (residuals.clock_label, "drifted [mm]")
        return scatter_plot(residuals, rows, (residuals.clock, 1e3 * partial @ way), curve, "Drift over time", axes)


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"
