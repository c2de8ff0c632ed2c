"""`bodyschema config`."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated

from bodyschema.cli.commands.options import HERE, RobotFile, flag, say

if TYPE_CHECKING:
    from bodyschema.daemon.config import Config
    from bodyschema.robot.description import RobotDescription

SCHEMA = 1  # of --json: robot.toml's tables, and this number


def config(
    *,
    robot: RobotFile = HERE,
    as_json: Annotated[
        bool, flag("Print all settings in force as JSON, defaults and environment included.", name="--json")
    ] = False,
) -> None:
    """Check robot.toml: print what was understood, or the line to correct.

    A setting can be changed for one call: `BODYSCHEMA_TABLE_KEY=value bodyschema COMMAND`.

    Needs: robot.toml (`bodyschema init`) and the URDF that it names.

    Next: `bodyschema replay` for a recording that you have; `bodyschema run`.
    """
    from bodyschema.daemon.config import Config

    loaded = Config.load(robot)
    if as_json:
        import msgspec

        tables = {"schema": SCHEMA, **msgspec.to_builtins(loaded.tables)}
        tables |= {"robot": msgspec.to_builtins(loaded.robot.robot), "camera": msgspec.to_builtins(loaded.robot.camera)}
        sys.stdout.write(msgspec.json.format(msgspec.json.encode(tables)).decode() + "\n")
        return
    loaded.require_learnable()
    _say_understood(loaded)


def _say_understood(checked: Config) -> None:
    from bodyschema.cli.recordings.synthesis import without_consequence
    from bodyschema.daemon.wiring.wiring import marker_source_lines
    from bodyschema.robot.urdf import REVOLUTE

    description, zenoh = checked.robot, checked.tables.zenoh
    cameras = checked.tables.vision.cameras
    camera_lines = _camera_lines(checked)
    say(f"{checked.file} is in order: robot {description.name}, {len(description.joints)} joints")
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
        place = "" if effect.where is None else f" at {effect.where}"
        source = "" if effect.source is None else f", from {effect.source}"
        numbers = (f"{p.name} = {value:.4g}" for p, value in zip(effect.parameters, effect.values, strict=True))
        say(f"  effect {effect.name}{place}{source}: {', '.join(numbers)}")
    for sentence in without_consequence(checked.simulation):
        say(f"  {sentence}")
    if checked.tables.unexplained is not None:
        say(f"  what is unexplained is learnt over {', '.join(checked.tables.unexplained['joints'])}")
    say(f"  sampler on {zenoh.sampler}, learner on {zenoh.learner}")
    say(f"  state in {checked.state_dir}")


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
