"""Wiring of zero-force and gaze of an arm of Dynamixel servos: the models, built from the robot's description."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from bodyschema.daemon.config import Config
from bodyschema.drivers.dynamixel.config import DynamixelConfig
from bodyschema.effects.gravity import GravityLoad
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.protocols import Clock
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.toml_file import line_of, read_toml

if TYPE_CHECKING:
    from bodyschema.drivers.dynamixel.gaze import Gaze
    from bodyschema.drivers.dynamixel.zero_force import ZeroForce


def holding_torques(robot: RobotDescription) -> Callable[[FloatArray], FloatArray]:
    """Return a function from joint angles [rad] (d,) to gravity torques [N·m] (d,), by the URDF's masses.

    Raises:
        ConfigError: the URDF states no masses that a joint bears.
    """
    load = GravityLoad(robot)
    if not load.known:
        raise ConfigError(
            "the URDF states no masses, so the arm's weight is unknown",
            file=robot.tree.file,
            remedy="Give its links <inertial> with mass and origin, or take [drivers.dynamixel.zero_force] out",
        )
    return lambda q: -load.torques(q[None])[0]


def open_drives(config: Config, servos: DynamixelConfig, clock: Clock) -> tuple[ZeroForce | Gaze, ...]:
    """Return the drives that may move the joints: those that robot.toml names, inactive until a person asks.

    Raises:
        ConfigError: the URDF states no masses, or robot.toml says that the arm is held in another way.
    """
    joints, drives = config.robot.joints, []
    _check_hold(config, servos)
    if servos.zero_force is not None:
        from bodyschema.drivers.dynamixel.zero_force import ZeroForce

        torques = holding_torques(config.robot)
        drives.append(ZeroForce(servos, servos.zero_force, joints, torques, clock))
    if servos.gaze is not None:
        from bodyschema.drivers.dynamixel.gaze import Gaze

        limits = list(zip(config.robot.lower.tolist(), config.robot.upper.tolist(), strict=True))
        drives.append(Gaze(servos.gaze, joints, limits, clock))
    return tuple(drives)


def _check_hold(config: Config, servos: DynamixelConfig) -> None:
    """Raise ConfigError if [robot] hold, used by the diagnosis, contradicts [drivers.dynamixel]."""
    hold, is_configured = config.robot.robot.hold, servos.zero_force is not None
    if is_configured == (hold == "zero_force"):
        return
    what = (
        f'[drivers.dynamixel.zero_force] bears the arm, but hold = "{hold}" in [robot] says otherwise to the diagnosis'
        if is_configured
        else 'hold = "zero_force" in [robot], but nothing bears the arm: there is no [drivers.dynamixel.zero_force]'
    )
    raise ConfigError(
        what,
        file=config.file,
        line=line_of(read_toml(config.file)[1], ("robot", "hold")),
        remedy='Write hold = "zero_force" in [robot]' if is_configured else "Add the table, or change hold",
    )
