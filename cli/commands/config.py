"""`bodyschema config`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import cyclopts

from bodyschema.cli.commands.options import HERE, RobotFile

if TYPE_CHECKING:
    from bodyschema.daemon.config import Config
    from bodyschema.effects import Effect
    from bodyschema.robot.description import RobotDescription

config = cyclopts.App(
    name="config",
    help="""Check or show robot.toml.

    Needs: robot.toml (`bodyschema init`) and the URDF that it names.

    Next: `bodyschema config check`, then `bodyschema run`, or `bodyschema replay` for a recording.
    """,
)


@config.command(sort_key=2)
def check(*, robot: RobotFile = HERE) -> None:
    """Check robot.toml: print what was understood, or the line to correct.

    Needs: robot.toml (`bodyschema init`) and the URDF that it names.

    Next: `bodyschema replay` for a recording that you have; `bodyschema run`.
    """
    from bodyschema.cli.recordings.synthesis import without_consequence
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.wiring.wiring import marker_source_lines
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
    for line in marker_source_lines(checked):
        say(f"  {line}")
    if (cameras is None and not checked.tables.marker_source) or (cameras and cameras.calibration is None):
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

    Needs: robot.toml (`bodyschema init`) and the URDF that it names.

    Next: change a setting in the file, or for once as `BODYSCHEMA_TABLE_KEY=value bodyschema COMMAND`.
    """
    import msgspec

    from bodyschema.daemon.config import Config

    checked = Config.load(robot)
    tables = msgspec.to_builtins(checked.tables)
    tables["robot"] = msgspec.to_builtins(checked.robot.robot)
    tables["camera"] = msgspec.to_builtins(checked.robot.camera)
    say(msgspec.json.format(msgspec.json.encode(tables)).decode())


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
