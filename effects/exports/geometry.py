"""Where a simulation has its joints, its camera and its marker."""

from __future__ import annotations

import numpy as np

from bodyschema.effects.corrected import corrected_geometry
from bodyschema.effects.simulation import Simulation
from bodyschema.interfaces.calibrated import CalibratedGeometry


def geometry_of(simulation: Simulation) -> CalibratedGeometry:
    """Return the geometry with all effects that it can have in it, the described one where there are none."""
    robot = simulation.robot
    described = CalibratedGeometry({}, robot.camera.pose, np.array(robot.robot.marker_xyz))
    return corrected_geometry(simulation) or described


def geometry_without_zeros(simulation: Simulation) -> CalibratedGeometry:
    """Return the same with the joints' zeros as they are described."""
    own, background = (
        [effect for effect in effects if effect.name != "joint_offset"]
        for effects in (simulation.effects, simulation.background)
    )
    return geometry_of(simulation.with_effects(own).with_background(background))
