"""Present friction behind an elastic drive."""

from __future__ import annotations

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals
from bodyschema.effects import Effect

from .evidence import over_quantity, remembered
from .presenter import FoundCause, Presenter, Workshop


class Hysteresis(Presenter):
    """Presenter of friction behind an elastic drive."""

    effect = "hysteresis"
    noun = "hysteresis of joint {joint}"

    def finding(self, found: FoundCause) -> str:
        lag, length = found.size("lag"), found.size("length")
        return f"{found.at} lags by {lag} behind its reading, against the way it went, and turns round over {length}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        way = workshop.amount(found, "length").replace("+", "")
        return (
            f"Look for friction behind the drive of {found.where}: bearing, seal, cable, brake. Until then come to "
            f"each pose from the same side, by several times {way}."
        )

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        correction = remembered(residuals, effect)
        strained = -correction / max(float(effect.values[0]), 1e-12)
        return over_quantity(residuals, effect, strained, f"direction of the last moves of {effect.where}", correction)
