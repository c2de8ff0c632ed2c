"""Present a wrong gear ratio."""

from __future__ import annotations

from .evidence import over_reading
from .presenter import FoundCause, Presenter, Workshop

_BACKWARDS = -1.0  # a scale error below this reverses the joint's direction


class JointScale(Presenter):
    """Presenter of a wrong gear ratio."""

    effect = "joint_scale"
    noun = "a wrong ratio of joint {joint}"
    plot = staticmethod(over_reading)

    def finding(self, found: FoundCause) -> str:
        error = found.numbers["scale_error"]
        if error < _BACKWARDS:
            return f"{found.at} counts the other way than its encoder says"
        return f"{found.at} turns {100 * abs(error):.3g} % {'more' if error > 0.0 else 'less'} than its encoder says"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        error = found.numbers["scale_error"]
        if error < _BACKWARDS:
            return f"Give the readings of {found.where} the other sign, in driver and recordings, and diagnose again."
        return (
            f"Multiply what the encoder of {found.where} reads by {1.0 + error:.5f}: check its gear "
            "ratio and its counts per turn."
        )
