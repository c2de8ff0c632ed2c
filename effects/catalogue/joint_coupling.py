"""A joint that moves with another."""

from __future__ import annotations

from bodyschema.effects.effect_type import Effect
from bodyschema.effects.encoder import EncoderEffect
from bodyschema.effects.joint_errors import JointErrors, Rows
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import Parameter, Place
from bodyschema.interfaces.records import FloatArray


class JointCoupling(EncoderEffect):
    """Coupling of a joint to another: true angle = reading + ratio · (reading of the other)."""

    name = "joint_coupling"
    rank = 4
    takes_source = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("ratio", 0.02),)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        assert place.source is not None
        return motion.q[:, [place.source]]

    def correction_rows(self, effect: Effect, place: Place) -> Rows:
        return {"ratios": [[place.joint, place.source, float(effect.values[0])]]}

    def add_to(self, joint: JointErrors, effect: Effect) -> None:
        joint.add_ratio(str(effect.source), float(effect.values[0]))
