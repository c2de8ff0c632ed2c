"""Cameras with a wrong focal length."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bodyschema.effects.effect_type import CameraEffect
from bodyschema.effects.optics import Optics
from bodyschema.effects.parameter import Parameter
from bodyschema.interfaces.records import FloatArray

if TYPE_CHECKING:
    from bodyschema.effects.effect import Effect
    from bodyschema.effects.simulation import Simulated


class CameraFocal(CameraEffect):
    """Wrong focal length: depth alone is scaled."""

    name = "camera_focal"
    rank = 3
    needs_stereo = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("focal_error", 0.01),)

    def optics(self, values: FloatArray) -> Optics:
        return Optics(focal_error=float(values[0]))

    def jacobian(self, run: Simulated, effect: Effect) -> FloatArray:
        return run.by_optics(effect)
