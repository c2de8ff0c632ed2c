"""Export the simulation as a URDF, as far as a URDF can hold it."""

from __future__ import annotations

from pathlib import Path

from bodyschema.effects.exports.arm_errors import geometry_of
from bodyschema.effects.simulation import Simulation
from bodyschema.robot.calibrated_files import calibrated_urdf

from .arm_errors import LeftOut, moment_notes, residual_note, sentences

_WHY_NOT = "a URDF has zeros, links and fixed frames alone"


def write_urdf(simulation: Simulation, file: Path, heading: str) -> list[str]:
    """Write the URDF of the simulation's robot, with the corrections that a URDF can hold, to `file`.

    Returns:
        Sentences on effects that the file does not hold.

    Raises:
        OSError: the file cannot be written.
    """
    robot, permanent = simulation.robot, simulation.with_permanent_changes
    geometry = geometry_of(permanent)
    left_out = [LeftOut(effect, _WHY_NOT) for effect in permanent.all_effects if not effect.kind.rigid]
    told = [*sentences(left_out), *residual_note(simulation), *moment_notes(simulation)]
    file.write_bytes(calibrated_urdf(robot, geometry, file.parent, "\n".join([heading, *told])))
    return told
