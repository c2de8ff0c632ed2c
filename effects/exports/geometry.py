"""Return the geometry of a simulation: joint origins, camera pose and marker position."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.corrected import corrected_geometry
from bodyschema.effects.simulation import Simulation
from bodyschema.robot.calibrated import CalibratedGeometry


def geometry_of(simulation: Simulation) -> CalibratedGeometry:
    """Return the geometry with all effects that it can hold; the described one where there are none."""
    robot = simulation.robot
    described = CalibratedGeometry({}, robot.camera.pose, np.array(robot.robot.marker_xyz))
    return corrected_geometry(simulation) or described


def geometry_without_zeros(simulation: Simulation) -> CalibratedGeometry:
    """Return the geometry without joint offsets."""
    own, background = (
        [effect for effect in effects if not effect.kind.is_zero]
        for effects in (simulation.effects, simulation.background)
    )
    return geometry_of(simulation.with_effects(own).with_background(background))
