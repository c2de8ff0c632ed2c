"""A stereo pair with a wrong baseline, or an instrument with a wrong scale."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bodyschema.effects.effect_type import CameraEffect
from bodyschema.effects.optics import Optics
from bodyschema.effects.parameter import Parameter
from bodyschema.interfaces.records import FloatArray

if TYPE_CHECKING:
    from bodyschema.effects.effect import Effect
    from bodyschema.effects.simulation import Simulated


class CameraScale(CameraEffect):
    """Wrong baseline: everything measured grows or shrinks."""

    name = "camera_scale"
    rank = 2

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("scale_error", 0.01),)

    def optics(self, values: FloatArray) -> Optics:
        return Optics(scale_error=float(values[0]))

    def jacobian(self, run: Simulated, effect: Effect) -> FloatArray:
        return run.by_optics(effect)
