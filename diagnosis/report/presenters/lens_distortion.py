"""Present remaining lens distortion."""

from __future__ import annotations

import numpy as np

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals, binned
from bodyschema.effects import Effect

from .evidence import attributed, scatter_plot
from .presenter import FoundCause, Presenter, Workshop


class LensDistortion(Presenter):
    """Presenter of remaining lens distortion."""

    effect = "lens_distortion"
    noun = "lens distortion"

    def finding(self, found: FoundCause) -> str:
        return f"the lenses still distort: k1 = {found.numbers['k1']:+.3g}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        left = f"k1 = {found.numbers['k1']:+.3g} left"
        return f"Calibrate the lenses again: the images that are called rectified have {left}."

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        """Plot radially in the image, over the distance from its centre."""
        assert residuals.calibration is not None
        partial, own = attributed(residuals, effect)
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
        return scatter_plot(residuals, rows, (radius, y), (curve.x, curve.y), "Outwards in the left image", axes)
