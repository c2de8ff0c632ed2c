"""Read and write extended.toml: a robot.toml with `[[effects]]`, and optionally `[unexplained]`.

[[effects]]
effect = "joint_compliance"
where = "shoulder"
compliance_rad_per_Nm = 0.0031

[[background]]                  # manufacturing tolerances, with the same keys
effect = "link_geometry"
where = "elbow"
x_m = 0.0002

[unexplained]
model = "unexplained.kbmap"     # relative to this file
joints = ["shoulder", "elbow"]  # inputs: readings of these joints
factors = [1.0, 1.0]            # factor on each input; 1 by default
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bodyschema.interfaces.errors import ConfigError, RobotError
from bodyschema.interfaces.whole_files import write_atomically
from bodyschema.robot.calibrated_files import tables_elsewhere
from bodyschema.robot.description import FARTHEST_CAMERA_M, LONGEST_TOOL_M, RobotDescription, Vector3
from bodyschema.robot.limited import read_at_most
from bodyschema.robot.suggest import did_you_mean
from bodyschema.robot.toml_file import convert, line_in_entry, line_of, read_toml
from bodyschema.robot.toml_text import toml_text
from kbmaps import ModelFormatError

from .effect_type import CameraEffect, Effect
from .parameter import Parameter
from .registry import EFFECT_TYPES
from .simulation import Simulation
from .unexplained import Unexplained, stored_model

EXTENDED_FILE = "extended.toml"
MODEL_FILE = "unexplained.kbmap"
EFFECTS, BACKGROUND, UNEXPLAINED = "effects", "background", "unexplained"
# A map of ten joints takes 1.4 MB, one of the largest learnt networks 100 MB.
MOST_MODEL_BYTES = 2**28
_HEAD = ("effect", "where", "source")
# By suffix of a number's name: largest plausible value, the unit it then seems to be in, and the remedy.
_UNITS: tuple[tuple[str, float, str, str], ...] = (
    ("_kgm", 100.0, "g·m", "Give kg·m"),
    ("_kg", 500.0, "grams", "Give kilograms"),
    ("_rad_per_Nm", 1.0, "degrees or N·mm", "Give radians for each newton metre"),
    ("_m_per_N", 0.1, "millimetres", "Give metres for each newton"),
    ("_rad", math.pi, "degrees", "Give radians: 1° is 0.01745"),
    ("_m", LONGEST_TOOL_M, "millimetres", "Give metres"),
    ("latency_s", 5.0, "milliseconds", "Give seconds"),
    ("_error", 0.9, "percent", "Give a fraction: 1 % is 0.01"),
    ("ratio", 10.0, "percent", "Give a fraction: 1 % is 0.01"),
    ("fraction", 1.0, "percent", "Give a fraction: 5 % is 0.05"),
    ("k2", 50.0, "a coefficient for pixels", "Give it for rays: r is the tangent of the angle off the axis"),
    ("k1", 50.0, "a coefficient for pixels", "Give it for rays: r is the tangent of the angle off the axis"),
)


class _Placement(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [unexplained.placement]: camera and marker poses assumed by a model of the marker's position."""

    camera_xyz: Vector3
    camera_rpy: Vector3
    marker_xyz: Vector3

    def of(self, robot: RobotDescription) -> RobotDescription:
        """Return the robot with its camera and marker at these poses."""
        camera = msgspec.structs.replace(robot.camera, xyz=self.camera_xyz, rpy=self.camera_rpy)
        return robot.with_placement(camera.pose, np.array(self.marker_xyz))


class _UnexplainedTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [unexplained]."""

    model: str
    joints: tuple[str, ...]
    factors: tuple[float, ...] | None = None
    placement: _Placement | None = None


def load_simulation(file: Path) -> Simulation:
    """Load the robot of robot.toml, or of extended.toml with its effects.

    Raises:
        ConfigError: see `RobotDescription.load`, `read_effects` and `read_unexplained`.
    """
    tables, text = read_toml(file)
    return simulation_of(RobotDescription.from_tables(tables, text, file), tables, text)


def simulation_of(robot: RobotDescription, tables: Mapping[str, Any], text: str) -> Simulation:
    """Load the simulation as `load_simulation` does, from the tables and the text of the robot's file."""
    effects, background = (read_effects(robot, tables, text, robot.file, key) for key in (EFFECTS, BACKGROUND))
    return Simulation(robot, effects, read_unexplained(robot, tables, text, robot.file), background)


def read_effects(
    robot: RobotDescription, tables: Mapping[str, Any], text: str, file: Path, key: str = EFFECTS
) -> tuple[Effect, ...]:
    """Read the effects in `[[effects]]`, or another list `key` of the same form, in order; empty without it.

    Raises:
        ConfigError: an effect, a joint or a number is unknown, missing, or in another unit; names line and remedy.
    """
    entries = tables.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        remedy = f"Write each effect under a heading [[{key}]]"
        raise ConfigError(f"{key} is not a list of tables", file=file, line=line_of(text, (key,)), remedy=remedy)
    effects: list[Effect] = []
    for place, entry in enumerate(entries):
        try:
            effect = _effect(robot, entry)
            effects.append(effect.with_ordinal(sum(other.key == effect.key for other in effects)))
        except _InvalidEntry as wrong:
            line = line_in_entry(text, key, place, wrong.key)
            what = f"{'effect' if key == EFFECTS else key} {place + 1}: {wrong.what}"
            raise RobotError(what, file=file, line=line, remedy=wrong.remedy) from None
    return tuple(effects)


def read_unexplained(robot: RobotDescription, tables: Mapping[str, Any], text: str, file: Path) -> Unexplained | None:
    """Read the model in the table `[unexplained]`; return None without it.

    Raises:
        ConfigError: a key or a joint is unknown, or the model's file is missing, damaged, or for other joints.
    """
    if UNEXPLAINED not in tables:
        return None
    table = convert(tables[UNEXPLAINED], _UnexplainedTable, file=file, text=text, prefix=(UNEXPLAINED,))
    model_file, line = file.parent / table.model, line_of(text, (UNEXPLAINED, "model"))
    try:
        model = stored_model(read_at_most(model_file, MOST_MODEL_BYTES))
    except OSError as error:
        raise RobotError(
            f"unexplained.model: {table.model} cannot be read: {error.strerror}",
            file=file,
            line=line,
            remedy="Put the file there, or take the table [unexplained] out",
        ) from error
    except ModelFormatError as error:
        raise RobotError(f"unexplained.model: {table.model}: {error}", file=file, line=line) from error
    try:
        described = robot if table.placement is None else table.placement.of(robot)
        return Unexplained.of(described, model, table.joints, table.factors)
    except RobotError as error:
        line = line_of(text, (UNEXPLAINED, "factors" if "factor" in error.what else "joints"))
        raise RobotError(f"unexplained: {error.what}", file=file, line=line, remedy=error.remedy) from None


def write_extended(simulation: Simulation, folder: Path, heading: str, *, replace: bool = False) -> Path:
    """Write the simulation as `EXTENDED_FILE` into `folder`, which is created if needed.

    The URDF stays in place and is named relative to `folder`. Other tables of robot.toml are kept; store and checkpoint
    go to a separate folder. If robot.toml does not know the camera's pose or the marker's position, those of the
    simulation are written instead and stay marked as unknown.

    Returns:
        The path of the extended.toml.

    Raises:
        ConfigError: the file exists already, or cannot be written.
        ValueError: the simulation's residual cannot be stored.
    """
    file = folder / EXTENDED_FILE
    simulation = simulation.placed
    tables = tables_elsewhere(simulation.robot, folder)
    for key in (EFFECTS, BACKGROUND, UNEXPLAINED):
        tables.pop(key, None)
    for key, effects in ((EFFECTS, simulation.effects), (BACKGROUND, simulation.background)):
        if effects:
            tables[key] = [effect.table() for effect in effects]
    residual = simulation.residual
    if residual is not None:
        if not isinstance(residual, Unexplained):
            raise ValueError(f"a residual that can be stored is an Unexplained, not a {type(residual).__name__}")
        tables[UNEXPLAINED] = _unexplained_table(residual)
    text = f"# {heading}\n\n{toml_text(tables)}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if file.exists() and not replace:
            raise ConfigError("is there already", file=file, remedy="Give another folder")
        model = {} if residual is None else {folder / MODEL_FILE: residual.model.to_bytes()}
        write_atomically(model | {file: text.encode()})
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=folder, remedy="Give another folder") from error
    return file


def _unexplained_table(residual: Unexplained) -> dict[str, Any]:
    table = {"model": MODEL_FILE, "joints": list(residual.joints), "factors": list(residual.factors)}
    if residual.is_of_place:
        robot = residual.robot
        table["placement"] = msgspec.to_builtins(_Placement(robot.camera.xyz, robot.camera.rpy, robot.robot.marker_xyz))
    return table


class _InvalidEntry(Exception):
    """Raised for an invalid effect, with the key that is wrong."""

    def __init__(self, what: str, key: str | None = None, remedy: str = "") -> None:
        self.what, self.key, self.remedy = what, key, remedy
        super().__init__(what)


def _effect(robot: RobotDescription, entry: Mapping[str, Any]) -> Effect:
    name, where, source = (_text(entry, key) for key in _HEAD)
    if name is None:
        raise _InvalidEntry("the key effect is missing", remedy=f"Name one of {', '.join(EFFECT_TYPES)}")
    if name not in EFFECT_TYPES:
        raise _InvalidEntry(f"there is no effect {name!r}", "effect", did_you_mean(name, EFFECT_TYPES))
    try:
        resting = Effect.at(robot, name, where, source)
    except RobotError as error:
        raise _InvalidEntry(error.what, _invalid_entry(error.what), error.remedy) from None
    names = [p.name for p in resting.parameters]
    for key in entry:
        if key not in (*names, *_HEAD):
            raise _InvalidEntry(f"{name} has no number {key!r}", key, did_you_mean(key, names))
    values = [_number(entry, p, resting) for p in resting.parameters]
    amounts = {resting.parameters[k].name for k in resting.all_amounts}
    if amounts.isdisjoint(entry):
        raise _InvalidEntry(f"{name} says of nothing how much", remedy=f"Give {', '.join(names)}")
    try:
        return Effect.at(robot, name, where, source, values)
    except RobotError as error:
        raise _InvalidEntry(error.what, next((n for n in names if n in error.what), None), error.remedy) from None


def _invalid_entry(what: str) -> str | None:
    """Return the key that a message about an effect's place refers to."""
    return next((key for key in ("source", "where") if f"{key} " in what or f"no {key}" in what), "where")


def _text(entry: Mapping[str, Any], key: str) -> str | None:
    value = entry.get(key)
    if value is not None and not isinstance(value, str):
        raise _InvalidEntry(f"{key} = {value!r} is no text", key, "Write a name in quotes")
    return value


def _number(entry: Mapping[str, Any], parameter: Parameter, effect: Effect) -> float:
    name, of_camera = parameter.name, isinstance(effect.kind, CameraEffect)
    if name not in entry:
        if parameter.nominal is None:
            raise _InvalidEntry(f"{effect.name}: {name} is missing", remedy="It has no usual value: give it")
        return parameter.nominal
    value = entry[name]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _InvalidEntry(f"{name} = {value!r} is no number", name, "Write it like 0.05 or 1e-3, without a unit")
    if not abs(value) <= sys.float_info.max:  # an integer of TOML may be larger
        raise _InvalidEntry(f"{name} = {value} is not finite", name)
    if parameter.never_negative and value < 0.0:
        raise _InvalidEntry(f"{name} = {value:g}: it is never negative", name, "Take the minus away, or the effect")
    if parameter.below_one and not 0.0 <= value < 1.0:
        raise _InvalidEntry(f"{name} = {value:g} is no share", name, "Give a number from 0 to below 1")
    for ending, largest, unit, remedy in _UNITS:
        if parameter.is_amount and name.endswith(ending):
            if abs(value) > (FARTHEST_CAMERA_M if of_camera and ending == "_m" else largest):
                raise _InvalidEntry(f"{name} = {value:g}: this looks like {unit}", name, remedy)
            break
    return float(value)
