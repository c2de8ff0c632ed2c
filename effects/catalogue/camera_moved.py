"""A camera that is bumped at a moment."""

from __future__ import annotations

from bodyschema.effects.effect_type import CameraEffect, Effect, SimulationRun
from bodyschema.effects.moments import since, with_moment
from bodyschema.effects.motion import moved_by_observer, transforms
from bodyschema.effects.parameter import T0, Parameter, shifts, turns
from bodyschema.interfaces.records import FloatArray


class CameraMoved(CameraEffect):
    """Pose of the camera in its frame before, from a moment on."""

    name = "camera_moved"
    rank = 1
    stays_as = "camera_pose"
    search = "moment"

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (*shifts(0.01), *turns(0.02), T0)

    def pose(self, values: FloatArray) -> FloatArray:
        return transforms(values[None, :6])[0]

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        moved = moved_by_observer(effect.values, run.x_camera)
        return with_moment(run.optical(moved) * since(run.motion, effect))
