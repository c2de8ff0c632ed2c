"""Lenses that still distort after rectification."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bodyschema.effects.effect_type import CameraEffect
from bodyschema.effects.optics import Optics
from bodyschema.effects.parameter import Parameter
from bodyschema.interfaces.records import FloatArray

if TYPE_CHECKING:
    from bodyschema.effects.effect import Effect
    from bodyschema.effects.simulation import Simulated


class LensDistortion(CameraEffect):
    """Radial distortion left in the images."""

    name = "lens_distortion"
    rank = 4
    needs_stereo = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (Parameter("k1", 0.02), Parameter("k2", 0.02))

    def optics(self, values: FloatArray) -> Optics:
        return Optics(k1=float(values[0]), k2=float(values[1]))

    def jacobian(self, run: Simulated, effect: Effect) -> FloatArray:
        return run.by_optics(effect)
