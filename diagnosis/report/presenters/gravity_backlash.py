"""Present backlash in a joint whose load holds it on one flank."""

from __future__ import annotations

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals
from bodyschema.effects import Effect
from bodyschema.effects.motion import flanks

from .evidence import load, over_quantity
from .presenter import FoundCause, Presenter, Workshop


class GravityBacklash(Presenter):
    """Presenter of backlash in a joint whose load holds it on one flank."""

    effect = "gravity_backlash"
    noun = "play of joint {joint}, which hangs on one flank"

    def finding(self, found: FoundCause) -> str:
        return f"{found.at} has {found.size('width')} of play and hangs on the flank to which the weight pulls it"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        play = workshop.amount(found, "width").replace("+", "")
        return (
            f"Tighten or preload the gear of {found.where}, or load it by a spring so that it stays on one flank. "
            f"Poses in which the weight pulls the other way differ by {play}, from whichever side they are reached."
        )

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        torque, label = load(residuals, effect)
        side = flanks(torque, float(effect.values[1]))
        return over_quantity(residuals, effect, torque, label, 0.5 * effect.values[0] * side)
