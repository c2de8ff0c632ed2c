"""`bodyschema config`."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import cyclopts
from cyclopts import Parameter

from bodyschema.cli.commands.options import HERE, RobotFile, flag, several

if TYPE_CHECKING:
    from bodyschema.daemon.config import Config
    from bodyschema.effects import Effect
    from bodyschema.robot.description import RobotDescription

config = cyclopts.App(
    name="config",
    help="""Write, check or show robot.toml.

    Needs: the URDF of your robot; `config init --sim` needs nothing.

    Next: `bodyschema config init`, then `bodyschema config check`.
    """,
)


@config.command(sort_key=1)
def init(
    *,
    robot: Annotated[Path, Parameter(help="The file to write.")] = HERE,
    urdf: Annotated[Path | None, Parameter(help="Your robot's URDF: joints and links are taken from it.")] = None,
    sim: Annotated[bool, flag("A whole example: the simulated upper body.")] = False,
    lerobot: Annotated[
        str | None, Parameter(help="An arm of LeRobot: so101, so100, moss, koch or koch_leader; with its URDF.")
    ] = None,
    calibration: Annotated[Path | None, Parameter(help="LeRobot's calibration of this arm, a JSON file.")] = None,
    port: Annotated[
        tuple[str, ...], several("Where the arm's servos are; of several, and without any, it is found")
    ] = (),
) -> None:
    """Write a commented robot.toml. Never replaces a file.

    With --urdf the longest chain of joints is filled in; without it, the names are examples. With --lerobot the servos
    are filled in as well, with IDs, directions and zeros from LeRobot's calibration: one robot.toml for a leader,
    another one for a follower. Nothing is written to any servo.

    Needs: your robot's URDF; with --sim nothing at all; with --lerobot also LeRobot's calibration of the arm.

    Next: correct what is marked CHECK, then `bodyschema config check`. With --sim nothing is left to correct:
    `bodyschema run --sim`. With --lerobot: `bodyschema joints`.
    """
    from bodyschema.interfaces.errors import ConfigError

    try:
        if sim:
            _copy_model(robot)
        elif lerobot is not None:
            write_new(robot, _of_lerobot(lerobot, urdf, robot, calibration, port))
        else:
            from bodyschema.cli.hardware.robot_template import EXAMPLE, guess_from, robot_toml

            write_new(robot, robot_toml(EXAMPLE if urdf is None else guess_from(urdf, robot)))
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=robot, remedy="Give another --robot") from error
    following = "run --sim" if sim else "config check" if lerobot is None else "joints"
    say(f"{robot} written. Next: `bodyschema {following} --robot {robot}`")


@config.command(sort_key=2)
def check(*, robot: RobotFile = HERE) -> None:
    """Check robot.toml: print what was understood, or the line to correct.

    Needs: robot.toml (`bodyschema config init`) and the URDF that it names.

    Next: `bodyschema replay` for a recording that you have; `bodyschema run`.
    """
    from bodyschema.cli.recordings.synthesis import without_consequence
    from bodyschema.daemon.config import Config
    from bodyschema.robot.urdf import REVOLUTE

    checked = Config.load(robot)
    checked.require_learnable()
    description, zenoh = checked.robot, checked.tables.zenoh
    cameras = checked.tables.vision.cameras
    camera_lines = _camera_lines(checked)
    say(f"{robot} is in order: robot {description.name}, {len(description.joints)} joints")
    for name, lower, upper in zip(description.joints, description.lower, description.upper, strict=True):
        unit, scale = ("°", 57.29577951) if description.tree.joint(name).kind in REVOLUTE else (" m", 1.0)
        say(f"  {name}: {scale * lower:.4g}{unit} to {scale * upper:.4g}{unit}")
    for joint in _standing_still(description):
        say(
            f"  {joint}: on the way, but not in joints: stands still at {description.robot.held_at.get(joint, 0.0):.4g}"
        )
    known = {True: "known", False: "only roughly known: fitted first"}
    section, camera = description.robot, description.camera
    say(f"  marker on {section.marker_link} at {_numbers(section.marker_xyz)} m, {known[section.marker_known]}")
    say(
        f"  camera on {camera.parent_link} at {_numbers(camera.xyz)} m, roll, pitch, yaw "
        f"{_numbers(map(math.degrees, camera.rpy))}°, {known[camera.pose_known]}"
    )
    for line in camera_lines:
        say(f"  {line}")
    if cameras is None or cameras.calibration is None:
        seen = description.calibration
        stereo = "described" if seen else "not described: no images can be used, recordings can"
        say(f"  {'stereo' if seen is None or seen.is_stereo else 'one camera, its'} calibration {stereo}")
    for effect in checked.simulation.effects:
        say(f"  effect {_effect_line(effect)}")
    for sentence in without_consequence(checked.simulation):
        say(f"  {sentence}")
    if checked.tables.unexplained is not None:
        say(f"  what is unexplained is learnt over {', '.join(checked.tables.unexplained['joints'])}")
    say(f"  sampler on {zenoh.sampler}, learner on {zenoh.learner}")
    say(f"  state in {checked.state_dir}")


@config.command(sort_key=3)
def show(*, robot: RobotFile = HERE) -> None:
    """Print all settings as they are in force, defaults and environment included, as JSON.

    Needs: robot.toml (`bodyschema config init`) and the URDF that it names.

    Next: change a setting in the file, or for once as `BODYSCHEMA_TABLE_KEY=value bodyschema COMMAND`.
    """
    import msgspec

    from bodyschema.daemon.config import Config

    checked = Config.load(robot)
    tables = msgspec.to_builtins(checked.tables)
    tables["robot"] = msgspec.to_builtins(checked.robot.robot)
    tables["camera"] = msgspec.to_builtins(checked.robot.camera)
    say(msgspec.json.format(msgspec.json.encode(tables)).decode())


def _of_lerobot(name: str, urdf: Path | None, robot: Path, calibration: Path | None, ports: Sequence[str]) -> str:
    """Return a robot.toml for an arm of LeRobot."""
    from bodyschema.cli.hardware.lerobot_robot import lerobot_arm, lerobot_port, lerobot_robot_toml
    from bodyschema.daemon.wiring import servos as servo_wiring
    from bodyschema.daemon.wiring.wiring import connected_cameras
    from bodyschema.interfaces.errors import ConfigError
    from bodyschema.robot.lerobot import where_calibrations_are

    arm = lerobot_arm(name)
    if urdf is None:
        raise ConfigError(
            "--lerobot needs the arm's URDF", remedy="Give it with --urdf; SO-ARM100 has one in Simulation/"
        )
    if calibration is None:
        raise ConfigError(
            "--lerobot needs the arm's calibration", remedy=f"Give --calibration. {where_calibrations_are()}"
        )
    if len(ports) != 1:
        ports = servo_wiring.ports_to_scan(ports, None)
        ports = [lerobot_port(arm, lambda bauds: servo_wiring.scan(ports, bauds, lambda _: None))]
    return lerobot_robot_toml(arm, urdf, robot, calibration, ports[0], connected_cameras())


def _effect_line(effect: Effect) -> str:
    """Return an effect as one line: name, place, numbers."""
    place = "" if effect.where is None else f" at {effect.where}"
    source = "" if effect.source is None else f", from {effect.source}"
    numbers = (f"{p.name} = {value:.4g}" for p, value in zip(effect.parameters, effect.values, strict=True))
    return f"{effect.name}{place}{source}: {', '.join(numbers)}"


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{round(value, 4) + 0.0:.4g}" for value in values)


def _camera_lines(config: Config) -> list[str]:
    if config.tables.vision.cameras is None:
        return []
    from bodyschema.daemon.wiring.cameras import camera_lines

    return list(camera_lines(config))


def _standing_still(description: RobotDescription) -> list[str]:
    """Return the names of the moving joints between camera and marker that are not learnt."""
    from bodyschema.robot.urdf import MOVING

    path = description.tree.path(description.camera.parent_link, description.robot.marker_link)
    return [joint.name for joint, _ in path if joint.kind in MOVING and joint.name not in description.joints]


def say(text: str) -> None:
    """Print a line as it is."""
    from rich.console import Console

    Console(highlight=False, soft_wrap=True).print(text, markup=False)


def write_new(file: Path, text: str) -> None:
    """Write a new file. Raise ConfigError if it exists."""
    from bodyschema.interfaces.errors import ConfigError
    from bodyschema.interfaces.whole_files import write_whole

    if os.path.lexists(file):
        raise ConfigError("is there already", file=file, remedy="Give another --robot, or move it away")
    try:
        write_whole({file: text.encode()})
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=file, remedy="Give another --robot") from error


def _copy_model(robot: Path) -> None:
    from bodyschema.daemon.wiring.wiring import demonstration_model

    model = demonstration_model()
    write_new(robot, model.read_text(encoding="utf-8"))
    for urdf in model.parent.glob("*.urdf"):
        write_new(robot.parent / urdf.name, urdf.read_text(encoding="utf-8"))
