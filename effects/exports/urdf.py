"""The simulation as a URDF, as far as a URDF can say it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from effects.corrected import corrected_geometry
from effects.simulation import RIGID, Simulation
from interfaces.calibrated import CalibratedGeometry
from interfaces.calibrated_files import calibrated_urdf

from .joint_errors import LeftOut, sentences

_WHY_NOT = "a URDF has zeros, links and fixed frames alone"


def write_urdf(simulation: Simulation, file: Path, heading: str) -> list[str]:
    """Write the URDF of the simulation's robot, corrected where a URDF can be, to `file`.

    Args:
        heading: one line for the top: where it comes from.

    Returns:
        Sentences on what the file does not hold.

    Raises:
        OSError: it cannot be written.
    """
    robot, stayed = simulation.robot, simulation.after_moments
    geometry = corrected_geometry(stayed)
    if geometry is None:
        geometry = CalibratedGeometry({}, robot.camera.pose, np.array(robot.robot.marker_xyz))
    left_out = [LeftOut(effect, _WHY_NOT) for effect in stayed.all_effects if effect.name not in RIGID]
    told = sentences(left_out)
    if simulation.residual is not None:
        told.append(f"not in the file: [unexplained]: {_WHY_NOT}")
    file.write_bytes(calibrated_urdf(robot, geometry, file.parent, "\n".join([heading, *told])))
    return told
