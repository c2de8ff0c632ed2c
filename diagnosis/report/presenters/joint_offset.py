"""Present a joint offset."""

from __future__ import annotations

from .evidence import over_reading
from .presenter import FoundCause, Presenter, Workshop

_TURN_ORIGIN = "turn the origin of joint {} by as much about"


class JointOffset(Presenter):
    """Presenter of a joint offset."""

    effect = "joint_offset"
    noun = "a wrong zero of joint {joint}"
    plot = staticmethod(over_reading)

    def finding(self, found: FoundCause) -> str:
        return f"the zero of {found.at} is off by {found.signed('offset')}"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        move = "move the origin of joint {} by as much along" if workshop.slides(found) else _TURN_ORIGIN
        return (
            f"Add {workshop.amount(found, 'offset')} to what the encoder of {found.where} reads, in its homing "
            f"offset or in the driver. Or in the URDF: {move.format(found.where)} its axis{workshop.in_urdf}."
        )
