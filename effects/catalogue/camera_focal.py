"""Cameras with a wrong focal length."""

from __future__ import annotations

from bodyschema.effects.effect_type import CameraEffect, Effect, SimulationRun
from bodyschema.effects.optics import Optics
from bodyschema.effects.parameter import Parameter
from bodyschema.interfaces.records import FloatArray


class CameraFocal(CameraEffect):
    """Wrong focal length: depth alone is scaled."""

    name = "camera_focal"
    rank = 3
    needs_stereo = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("focal_error", 0.01),)

    def optics(self, values: FloatArray) -> Optics:
        return Optics(focal_error=float(values[0]))

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        return run.by_optics(effect)
