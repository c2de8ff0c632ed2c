"""A joint whose zero is wrong."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.effect_type import Effect
from bodyschema.effects.encoder import EncoderEffect
from bodyschema.effects.joint_errors import JointErrors
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import Parameter, Place
from bodyschema.interfaces.records import FloatArray


class JointOffset(EncoderEffect):
    """Constant joint offset: true angle = reading + offset."""

    name = "joint_offset"
    rank = 0
    rigid = True
    is_zero = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("offset_m", 0.005) if prismatic else Parameter("offset_rad", 0.05),)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        return np.ones((len(motion), 1))

    def add_to(self, joint: JointErrors, effect: Effect) -> None:
        joint.offset += float(effect.values[0])
