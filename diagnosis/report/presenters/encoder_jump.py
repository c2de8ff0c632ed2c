"""Present a joint offset that jumped."""

from __future__ import annotations

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals
from bodyschema.effects import Effect

from .evidence import over_quantity, remembered
from .presenter import FoundCause, Presenter, Workshop


class EncoderJump(Presenter):
    """Presenter of a joint offset that jumped."""

    effect = "encoder_jump"
    noun = "a jump of joint {joint}'s zero"

    def finding(self, found: FoundCause) -> str:
        return f"the zero of {found.at} jumped by {found.signed('jump')}{found.when}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        return (
            f"Look for what slipped at {found.where} (the horn's screw, a coupling, lost counts), tighten it, and home "
            f"the joint again. Readings from the jump on need {workshop.amount(found, 'jump')} more."
        )

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        correction = remembered(residuals, effect)
        return over_quantity(residuals, effect, residuals.clock, residuals.clock_label, correction)
