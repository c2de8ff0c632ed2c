"""The URDF with what a URDF can say of a simulation's effects: for other programs, which know of no effects.

extended.toml names the nominal URDF and has the effects beside it, so that nothing is applied twice.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyschema.interfaces.calibrated import CalibratedGeometry
from bodyschema.interfaces.calibrated_files import calibrated_urdf
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.robot import RobotDescription

from .effect import Effect
from .poses import transforms
from .simulation import RIGID, Simulation


def corrected_file(robot: RobotDescription) -> str:
    """The name of a robot's corrected URDF."""
    return f"{robot.tree.file.stem}_corrected.urdf"


def corrected_geometry(simulation: Simulation) -> CalibratedGeometry | None:
    """Joint origins, the camera's pose and the marker's place with the effects that these can have in them.

    None where there is no such effect, what the description calls not known aside.
    """
    simulation = simulation.placed
    robot = simulation.robot
    rigid = [effect for effect in simulation.all_effects if effect.name in RIGID]
    if not rigid:
        return None
    origins: dict[str, FloatArray] = {}
    # A zero turns about the axis of the frame where the link's own correction has put it.
    for effect in sorted(rigid, key=lambda effect: effect.name == "joint_offset"):
        if effect.where is not None:
            origin = origins.get(effect.where, robot.tree.joint(effect.where).T_parent_joint)
            origins[effect.where] = origin @ _moved(robot, effect)
    marker = np.array(robot.robot.marker_xyz)
    for effect in rigid:
        if effect.name == "tool_offset":
            marker = marker + effect.values
    return CalibratedGeometry(origins, robot.camera.pose @ simulation.camera_pose, marker)


def write_corrected(simulation: Simulation, folder: Path, heading: str) -> Path | None:
    """Write the URDF of the simulation's robot with `corrected_geometry` into `folder`, beside what else is there.

    Meshes stay where they are; their relative names are made to lead there. One that an earlier simulation left in the
    folder is replaced, or taken away where nothing is to be corrected.

    Returns:
        The file; None where nothing is to be corrected.

    Raises:
        ConfigError: it cannot be written.
    """
    geometry = corrected_geometry(simulation)
    file = folder / corrected_file(simulation.robot)
    try:
        if geometry is None:
            file.unlink(missing_ok=True)
            return None
        folder.mkdir(parents=True, exist_ok=True)
        file.write_bytes(calibrated_urdf(simulation.robot, geometry, folder, heading))
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=folder, remedy="Give another folder") from error
    return file


def _moved(robot: RobotDescription, effect: Effect) -> FloatArray:
    """By how much an effect moves its joint's frame (4, 4)."""
    if effect.name == "link_geometry":
        return transforms(effect.values[None])[0]
    along = effect.values[0] * robot.tree.joint(str(effect.where)).axis
    slides = robot.chain.prismatic[robot.joints.index(str(effect.where))]
    none = np.zeros(3)
    return transforms(np.concatenate([along, none] if slides else [none, along])[None])[0]
