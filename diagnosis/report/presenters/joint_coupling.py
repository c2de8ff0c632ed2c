"""Present a joint that moves with another."""

from __future__ import annotations

from .evidence import over_reading
from .presenter import FoundCause, Presenter, Workshop


class JointCoupling(Presenter):
    """Presenter of a joint that moves with another."""

    effect = "joint_coupling"
    noun = "joint {joint} moving with joint {source}"
    plot = staticmethod(over_reading)

    def finding(self, found: FoundCause) -> str:
        return f"{found.at} moves by {100 * found.numbers['ratio']:+.3g} % of joint {found.source}'s angle"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        ratio = f"{found.numbers['ratio']:+.5f}"
        return (
            f"In the driver, add {ratio} times the reading of {found.source} to that of {found.where}: "
            f"a tendon or a differential carries {found.source}'s motion on."
        )
