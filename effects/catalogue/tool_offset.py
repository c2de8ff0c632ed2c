"""A marker at another position on the hand."""

from __future__ import annotations

from bodyschema.effects.effect_type import Effect, SimulationRun, ToolEffect
from bodyschema.effects.parameter import Parameter, shifts
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription


class ToolOffset(ToolEffect):
    """A displacement of the marker in its link, as by another tool."""

    name = "tool_offset"
    rank = 0
    rigid = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return shifts(0.01)

    def is_free(self, robot: RobotDescription) -> bool:
        return not robot.robot.marker_known

    def shift(self, values: FloatArray) -> FloatArray:
        return values

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        return run.by_marker
