"""A camera pose that differs from the description."""

from __future__ import annotations

from bodyschema.effects.effect_type import CameraEffect, Effect, SimulationRun
from bodyschema.effects.motion import moved_by_observer, transforms
from bodyschema.effects.parameter import Parameter, shifts, turns
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription


class CameraPose(CameraEffect):
    """Pose of the camera in its nominal frame."""

    name = "camera_pose"
    rank = 0
    rigid = True

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        return (*shifts(0.01), *turns(0.02))

    def is_free(self, robot: RobotDescription) -> bool:
        return not robot.camera.pose_known

    def pose(self, values: FloatArray) -> FloatArray:
        return transforms(values[None])[0]

    def jacobian(self, run: SimulationRun, effect: Effect) -> FloatArray:
        return run.optical(run.since_moved(moved_by_observer(effect.values, run.x_placed)))
