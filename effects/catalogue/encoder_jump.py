"""A joint whose zero jumps at a moment."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.encoder import EncoderEffect
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import T0, Parameter, Place
from bodyschema.interfaces.records import FloatArray


class EncoderJump(EncoderEffect):
    """Change of the joint offset at a moment: true angle = reading + jump from then on."""

    name = "encoder_jump"
    rank = 5
    stays_as = "joint_offset"
    search = "moment"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("jump_m", 0.005) if prismatic else Parameter("jump_rad", 0.03), T0)

    def columns(self, motion: Motion, place: Place, values: FloatArray) -> FloatArray:
        after = motion.clock >= values[1]
        return np.stack([after.astype(np.float64), np.zeros(len(motion))], axis=1)
