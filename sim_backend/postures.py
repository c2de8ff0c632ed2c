"""Postures drawn independently, in which both cameras see the marker."""

from __future__ import annotations

import numpy as np

from bodyschema.effects import Simulation
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

from .bullet import Body
from .config import SimConfig
from .gaze import Gaze
from .physics_urdf import physics_urdf
from .randomness import Stream, generator
from .roles import JointRoles
from .sight import Sight
from .truth import TrueRobot
from .world import stereo_calibration

_BATCH = 500
_MOST_BATCHES = 400
# How far the head may be turned away from the marker [rad]: with it the head's angles say more than where the hand is.
_WANDER = np.radians(20.0)


def visible_postures(
    robot: RobotDescription, config: SimConfig, count: int, extension: Simulation | None = None
) -> FloatArray:
    """Postures (count, d) [rad or m], as encoders report them: guided joints uniform over their ranges, the head about
    where it would look at the marker, uniform as well, as far as the true cameras see the marker.

    Args:
        extension: the robot with effects; those that no chain has in it are not counted.

    Raises:
        ConfigError: the cameras see the marker in too few of the postures that were drawn.
    """
    calibration, truth = stereo_calibration(robot), TrueRobot.draw(robot, config, extension)
    roles, rng = JointRoles.of(robot), generator(config.seed, Stream.WAYPOINTS)
    guided, gaze = list(roles.guided), list(roles.gaze)
    found: list[FloatArray] = []
    with Body(physics_urdf(truth), robot.joints) as body:
        looking = Gaze(robot, calibration, roles.gaze, config.guide.gaze_speed_rad_s)
        sight = Sight(truth, calibration, roles, looking, body, config.camera)
        for _ in range(_MOST_BATCHES):
            q = np.tile((robot.lower + robot.upper) / 2, (_BATCH, 1))
            q[:, guided] = rng.uniform(robot.lower[guided], robot.upper[guided], (_BATCH, len(guided)))
            q = sight.gazed(q)
            q[:, gaze] += rng.uniform(-_WANDER, _WANDER, (_BATCH, len(gaze)))
            q = np.clip(q, robot.lower, robot.upper)
            found += list(q[sight.visible(q)])
            if len(found) >= count:
                return np.array(found[:count])
    raise ConfigError(
        f"the cameras see the marker in only {len(found)} of {_BATCH * _MOST_BATCHES} postures",
        remedy="Check [camera] xyz and rpy, marker_xyz and the joint limits",
    )
