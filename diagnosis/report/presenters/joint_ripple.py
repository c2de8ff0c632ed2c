"""Present a periodic error of a drive."""

from __future__ import annotations

from .evidence import over_reading
from .presenter import DEG, FoundCause, Presenter, Workshop, with_sign


class JointRipple(Presenter):
    """Presenter of a periodic error of a drive."""

    effect = "joint_ripple"
    noun = "a ripple of joint {joint}"
    plot = staticmethod(over_reading)

    def finding(self, found: FoundCause) -> str:
        numbers = found.numbers
        if "cycles_per_turn" in numbers:
            wave = f"±{numbers['amplitude_rad'] * DEG:.2g}°, {numbers['cycles_per_turn']:.3g} times a turn"
        else:
            wave = f"±{1e3 * numbers['amplitude_m']:.2g} mm, {numbers['cycles_per_m']:.3g} times a metre"
        return f"{found.at} has a ripple of {wave}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        numbers, phase = found.numbers, f"{with_sign(found.numbers['phase_rad'] * DEG)}°"
        if workshop.slides(found):
            cycles = numbers["cycles_per_m"]
            wave = f"{1e3 * numbers['amplitude_m']:.2g} mm·sin(360°·{cycles:.4g}/m·q {phase})"
            part = f"has a pitch of {1e3 / cycles:.3g} mm"
        else:
            cycles = numbers["cycles_per_turn"]
            wave = f"{numbers['amplitude_rad'] * DEG:.2g}°·sin({cycles:.4g}·q {phase})"
            part = f"comes round {cycles:.3g} times a turn: teeth, a strain wave, pole pairs"
        return f"Look in the drive of {found.where} for what {part}. Or add {wave} to its reading q."
