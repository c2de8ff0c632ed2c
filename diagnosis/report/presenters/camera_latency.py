"""Present images with late timestamps."""

from __future__ import annotations

import numpy as np

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals
from bodyschema.effects import Effect

from .evidence import attributed, scatter_plot
from .presenter import FoundCause, Presenter, Workshop


class CameraLatency(Presenter):
    """Presenter of images with late timestamps."""

    effect = "camera_latency"
    noun = "late images"

    def finding(self, found: FoundCause) -> str:
        return f"images are stamped {1e3 * found.numbers['latency_s']:.3g} ms late"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        late = found.numbers["latency_s"]
        what = "Subtract" if late > 0.0 else "Add"
        where = "from" if late > 0.0 else "to"
        return f"{what} {1e3 * abs(late):.3g} ms {where} the images' time stamps, or stop the arm for each sample."

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        partial, own = attributed(residuals, effect)
        velocity = -residuals.run.columns(effect)[:, :, 0]
        speed = np.linalg.norm(velocity, axis=1)
        y, fitted = (1e3 * speed * residuals.projected_amount(velocity, e) for e in (partial, own))
        rows, x = residuals.rows, 1e3 * speed
        slope = float(x[rows] @ fitted[rows]) / max(float(x[rows] @ x[rows]), 1e-12)
        ends = np.array([0.0, x[rows].max()])
        axes = ("speed of the marker [mm/s]", "ahead of the simulation [mm]")
        title = "Along the way of motion, over speed"
        return scatter_plot(residuals, rows, (x, y), (ends, slope * ends), title, axes)
