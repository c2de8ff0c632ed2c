"""A joint with a wrong gear ratio."""

from __future__ import annotations

from bodyschema.effects.effect_type import Effect
from bodyschema.effects.encoder import EncoderEffect
from bodyschema.effects.joint_errors import JointErrors, Rows
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import Parameter, Place
from bodyschema.interfaces.records import FloatArray


class JointScale(EncoderEffect):
    """Wrong gear ratio or counts per turn: true angle = reading · (1 + scale_error)."""

    name = "joint_scale"
    rank = 1

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("scale_error", 0.01),)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        return motion.q[:, [place.joint]]

    def correction_rows(self, effect: Effect, place: Place) -> Rows:
        return {"ratios": [[place.joint, place.joint, float(effect.values[0])]]}

    def add_to(self, joint: JointErrors, effect: Effect) -> None:
        joint.add_ratio(str(effect.where), float(effect.values[0]))
