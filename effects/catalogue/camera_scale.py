"""A wrong size of a tag, a ball or a calibration board, a wrong baseline, or an instrument's scale."""

from __future__ import annotations

from bodyschema.effects.effect_type import CameraEffect, Effect, SimulationRun
from bodyschema.effects.optics import Optics
from bodyschema.effects.parameter import Parameter
from bodyschema.interfaces.records import FloatArray


class CameraScale(CameraEffect):
    """Wrong scale: everything measured grows or shrinks."""

    name = "camera_scale"
    rank = 2
    scales_all = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        # 1 mm of a side of 50 mm; a print that was fitted to the page is 3 to 6 % too small.
        return (Parameter("scale_error", 0.02),)

    def optics(self, values: FloatArray) -> Optics:
        return Optics(scale_error=float(values[0]))

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        return run.by_optics(effect)
