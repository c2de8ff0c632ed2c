"""Write a corrected URDF with the effects that a URDF can hold, for programs that do not know effects.

extended.toml names the nominal URDF and lists the effects beside it, so that nothing is applied twice.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyschema.effects.motion import Motion, transforms
from bodyschema.effects.simulation import Simulation
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.whole_files import write_atomically
from bodyschema.robot.calibrated import CalibratedGeometry
from bodyschema.robot.calibrated_files import calibrated_urdf
from bodyschema.robot.description import RobotDescription

from .effect_type import Effect, StructureEffect, ToolEffect
from .encoder import EncoderEffect


def corrected_file(robot: RobotDescription) -> str:
    """Return the file name of a robot's corrected URDF."""
    return f"{robot.tree.file.stem}_corrected.urdf"


def corrected_geometry(simulation: Simulation) -> CalibratedGeometry | None:
    """Return joint origins, camera pose and marker position with the effects that these can hold.

    Return None if there is no such effect besides the parameters that the description marks as unknown.
    """
    simulation = simulation.placed
    robot = simulation.robot
    rigid = [effect for effect in simulation.all_effects if effect.kind.rigid]
    if not rigid:
        return None
    origins: dict[str, FloatArray] = {}
    # An offset rotates about the axis after the link's own correction, so it is applied last.
    for effect in sorted(rigid, key=lambda effect: effect.kind.is_zero):
        if effect.where is not None:
            origin = origins.get(effect.where, robot.tree.joint(effect.where).T_parent_joint)
            origins[effect.where] = origin @ _moved(robot, effect)
    marker = np.array(robot.robot.marker_xyz)
    for effect in rigid:
        if isinstance(effect.kind, ToolEffect):
            marker = marker + effect.kind.shift(effect.values)
    return CalibratedGeometry(origins, robot.camera.pose @ simulation.camera_pose, marker)


def write_corrected(simulation: Simulation, folder: Path, heading: str) -> Path | None:
    """Write the URDF of the simulation's robot with `corrected_geometry` into `folder`.

    Meshes stay in place; relative names are rewritten to point to them. A corrected URDF of an earlier simulation is
    replaced, or removed if there is nothing to correct.

    Returns:
        The file; None if there is nothing to correct.

    Raises:
        ConfigError: the file cannot be written.
    """
    geometry = corrected_geometry(simulation)
    file = folder / corrected_file(simulation.robot)
    try:
        if geometry is None:
            file.unlink(missing_ok=True)
            return None
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically({file: calibrated_urdf(simulation.robot, geometry, folder, heading)})
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=folder, remedy="Give another folder") from error
    return file


def _moved(robot: RobotDescription, effect: Effect) -> FloatArray:
    """Return the transform (4, 4) by which an effect moves its joint's frame."""
    if isinstance(effect.kind, StructureEffect) and (frame := effect.kind.frame(effect.values)) is not None:
        return frame
    along = effect.values[0] * robot.tree.joint(str(effect.where)).axis
    slides = robot.chain.prismatic[robot.joints.index(str(effect.where))]
    none = np.zeros(3)
    return transforms(np.concatenate([along, none] if slides else [none, along])[None])[0]


class LiveEncoders:
    """True joint angles from encoder readings, in the order of the readings.

    Every reading drives a backlash. It starts on the side of the first change; before any change, it is centred.

    Args:
        row_readings: number of readings between rows, for effects that depend on the previous row.
    """

    def __init__(self, simulation: Simulation, row_readings: int = 1) -> None:
        self._errors = [
            (place.joint, effect.kind.live(place, effect.values, row_readings))
            for effect in simulation.all_effects
            if isinstance(effect.kind, EncoderEffect)
            for place in [simulation.place(effect)]
        ]

    def true_angles(self, q: FloatArray, t: float, move: FloatArray) -> FloatArray:
        """Return true joint angles (d,) [rad, m] at the readings q (d,) and the time t [s].

        Args:
            move: the move (d,) since the previous row, for joints that have not settled.
        """
        angles, motion = q.copy(), Motion.at(q, t)
        for joint, error in self._errors:
            angles[joint] += error.at(motion, float(move[joint]))
        return angles
