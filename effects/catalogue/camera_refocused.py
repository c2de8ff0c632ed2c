"""A lens that refocuses at a moment."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.effect_type import CameraEffect
from bodyschema.effects.motion import Motion
from bodyschema.effects.parameter import T0, Parameter
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray


class CameraRefocused(CameraEffect):
    """Change of the focal length from a moment on: depth alone is scaled."""

    name = "camera_refocused"
    rank = 3
    needs_stereo = True
    search = "moment"
    alters_report = True

    @property
    def most_at_one_place(self) -> int:
        return 12  # an autofocus hunts: it jumps again and again, where what is bumped or slips does so once or twice

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("focal_error", 0.01), T0)

    def reported(
        self, x: FloatArray, motion: Motion, values: FloatArray, calibration: StereoCalibration | None
    ) -> FloatArray:
        later = motion.clock >= values[1]
        return x / np.where(later[:, None] & (np.arange(3) == 2), 1.0 + values[0], 1.0)
