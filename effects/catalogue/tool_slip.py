"""A marker that moves on the hand at a moment."""

from __future__ import annotations

from bodyschema.effects.effect_type import Effect, SimulationRun, ToolEffect
from bodyschema.effects.moments import since, with_moment
from bodyschema.effects.parameter import T0, Parameter, shifts
from bodyschema.interfaces.records import FloatArray


class ToolSlip(ToolEffect):
    """A displacement of the marker in its link from a moment on."""

    name = "tool_slip"
    rank = 1
    stays_as = "tool_offset"
    search = "moment"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (*shifts(0.01), T0)

    def shift(self, values: FloatArray) -> FloatArray:
        return values[:3]

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        return with_moment(run.by_marker * since(run.motion, effect))
