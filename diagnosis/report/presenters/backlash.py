"""Present backlash in a drive."""

from __future__ import annotations

import numpy as np

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals, ResidualSettings, binned
from bodyschema.diagnosis.report.svg_plot import Layout, Plot, span
from bodyschema.effects import Effect

from .evidence import attributed
from .presenter import FoundCause, Presenter, Workshop


class Backlash(Presenter):
    """Presenter of backlash in a drive."""

    effect = "backlash"
    noun = "play of joint {joint}"

    def finding(self, found: FoundCause) -> str:
        return f"{found.at} has {found.size('width')} of play"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        play = workshop.amount(found, "width").replace("+", "")
        return (
            f"Tighten or preload the gear of {found.where}. Until then come to each pose from the same side, by more "
            f"than {play}."
        )

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        k = residuals.run.simulation.place(effect).joint
        partial, _ = attributed(residuals, effect)
        rows, x, y = residuals.rows_moved_by(k), residuals.angles(k), residuals.as_angle(k, partial)
        half = 0.5 * residuals.unit(k)[0] * float(effect.values[0])
        plot = Plot(
            f"{effect.where} [{residuals.unit(k)[1]}]",
            f"{effect.where}: true less read [{residuals.unit(k)[1]}]",
            span(x[rows]),
            span(y[rows], cut=Layout.cut),
        )
        marks = []
        ends = np.array(plot.x)
        for way, look in ((1, "up"), (-1, "down")):
            moving = rows[residuals.direction[rows, k] == way]
            if not len(moving):
                continue
            some, bins = residuals.some(ResidualSettings.points // 2, moving), binned(x[moving], y[moving])
            marks.append(plot.dots(x[some], y[some], f"pale {look}"))
            marks.append(plot.line(ends, np.full(2, -way * half), f"fit {look}"))
            marks.append(plot.bars(bins.x, bins.y, bins.half, look))
        title = (
            f"How far {effect.where} is from its reading, moving up (blue) and down (orange); "
            "lines: half the play each way"
        )
        return Panel(title, plot.svg(*marks))
