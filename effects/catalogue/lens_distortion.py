"""Lens distortion that remains after rectification."""

from __future__ import annotations

from bodyschema.effects.effect_type import CameraEffect, Effect, SimulationRun
from bodyschema.effects.optics import Optics
from bodyschema.effects.parameter import Parameter
from bodyschema.interfaces.records import FloatArray


class LensDistortion(CameraEffect):
    """Radial distortion that remains in the images."""

    name = "lens_distortion"
    rank = 4
    needs_stereo = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("k1", 0.02), Parameter("k2", 0.02))

    def optics(self, values: FloatArray) -> Optics:
        return Optics(k1=float(values[0]), k2=float(values[1]))

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        return run.by_optics(effect)
