"""Present an encoder that sits off its axis."""

from __future__ import annotations

from .evidence import over_reading
from .presenter import DEG, FoundCause, Presenter, Workshop, with_sign


class JointEccentricity(Presenter):
    """Presenter of an encoder that sits off its axis."""

    effect = "joint_eccentricity"
    noun = "an eccentric encoder of joint {joint}"
    plot = staticmethod(over_reading)

    def finding(self, found: FoundCause) -> str:
        return f"the encoder of {found.at} sits off its axis: ±{found.numbers['amplitude_rad'] * DEG:.2g}° once a turn"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        amplitude, phase = (found.numbers[name] * DEG for name in ("amplitude_rad", "phase_rad"))
        return (
            f"Centre the encoder's magnet of {found.where} on the axis. Until then add "
            f"{amplitude:.3g}°·sin(q {with_sign(phase)}°) to its reading q."
        )
