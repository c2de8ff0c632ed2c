"""Present a joint that was read before it came to rest."""

from __future__ import annotations

import math

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals
from bodyschema.effects import Effect

from .evidence import over_quantity, remembered
from .presenter import FoundCause, Presenter, Workshop


class Settling(Presenter):
    """Presenter of a joint that was read before it came to rest."""

    effect = "settling"
    noun = "joint {joint} read before it rests"

    def finding(self, found: FoundCause) -> str:
        missing = f"{100 * found.numbers['fraction']:.2g} %"
        return f"{found.at} was read before it came to rest: {missing} of each move was missing"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        fraction, ended = found.numbers["fraction"], 0.001  # `ended`: remaining share at which a move has ended
        longer = math.log(ended) / math.log(fraction) if 0.0 < fraction < 1.0 else 2.0
        wait = f"{longer:.2g} times as long" if longer > 1.0 else "longer"
        return (
            f"Wait {wait} before {found.where} is read, which leaves {100 * ended:g} % of a move; or raise the gain "
            "of its controller."
        )

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        k = residuals.run.simulation.place(effect).joint
        factor, unit = residuals.unit(k)
        label = f"last move of {effect.where} [{unit}]"
        moves = factor * residuals.motion.moves[:, k]
        return over_quantity(residuals, effect, moves, label, remembered(residuals, effect))
