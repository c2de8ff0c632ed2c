"""Wiring of `bodyschema servos`: the selected servos, and the editor that changes their EEPROM."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

from bodyschema.daemon.config import Config
from bodyschema.drivers.dynamixel.config import Baud as DynamixelBaud
from bodyschema.drivers.dynamixel.config import DynamixelConfig
from bodyschema.drivers.dynamixel.joints import DYNAMIXEL
from bodyschema.drivers.feetech.config import Baud as FeetechBaud
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.feetech.joints import FEETECH
from bodyschema.drivers.serial_line import SerialLine, adapter_latency_s
from bodyschema.drivers.servos.config import ServoConfig
from bodyschema.drivers.servos.eeprom_editor import Change, EepromEditor, Outcome, WriteResult
from bodyschema.drivers.servos.model import Model
from bodyschema.drivers.servos.servo import IdentifiedServo
from bodyschema.drivers.servos.settings import BAUD, HOMING_OFFSET, ID, Setting, setting_called
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, SourceError
from bodyschema.robot.suggest import did_you_mean

__all__ = [
    "BAUD",
    "HOMING_OFFSET",
    "ID",
    "Change",
    "EepromEditor",
    "IdentifiedServo",
    "Outcome",
    "SelectedServo",
    "Setting",
    "WriteResult",
    "configured",
    "editor_of",
    "entry_of",
    "model_called",
    "setting_called",
    "settings_by_name",
    "stranger",
]

STRANGER = "-"  # instead of a joint's name
EEPROM_VENDORS = {
    "dynamixel": (DYNAMIXEL, DynamixelConfig.models, get_args(DynamixelBaud)),
    "feetech": (FEETECH, FeetechConfig.models, get_args(FeetechBaud)),
}


@dataclass(frozen=True, slots=True)
class SelectedServo:
    """A selected servo, before it is queried."""

    table: str  # its vendor's table in [drivers]
    port: str
    baud: int
    entry: ServoConfig
    model: Model


def configured(config: Config, joints: Sequence[str], bus: str | None) -> list[SelectedServo]:
    """Return the servos of robot.toml that move `joints`, or all of a bus; all servos if neither is given.

    Raises:
        ConfigError: there are none, or no such joint or bus.
    """
    tables = {name: getattr(config.tables.drivers, name) for name in EEPROM_VENDORS}
    table, servos = next(((name, servos) for name, servos in tables.items() if servos is not None), ("", None))
    if servos is None:
        remedy = "Add [drivers.dynamixel] or [drivers.feetech] (docs/hardware.md), or give --port and --id"
        raise ConfigError("no servos are configured", file=config.file, remedy=remedy)
    for what, names, known in (("joint", joints, config.robot.joints), ("bus", [bus] if bus else [], servos.buses)):
        for name in names:
            if name not in known:
                raise ConfigError(f"unknown {what} {name!r}", remedy=did_you_mean(name, known))
    found = []
    for entry in servos.servos:
        name = servos.bus_of(entry)
        if (not joints or entry.joint in joints) and bus in (None, name):
            place = servos.buses[name]
            found.append(SelectedServo(table, place.port, place.baud, entry, servos.model_of(entry)))
    if not found:
        raise ConfigError(f"none of these joints is on the bus {bus!r}", file=config.file, remedy="Drop --bus")
    return found


def stranger(port: str, baud: int, id: int) -> SelectedServo:
    """Return the servo with an ID that robot.toml does not name, of any vendor; raise SourceError without an answer."""
    for table in [table for table, (_, _, bauds) in EEPROM_VENDORS.items() if baud in bauds]:
        with editor_of(table) as editor:
            model = editor.model_at(editor.bus(port, baud), id)
        if model is not None:
            return SelectedServo(table, port, baud, entry_of(STRANGER, id, model), model)
    raise SourceError(
        f"no servo that we know answers to ID {id} on {port} at {baud:,} bit/s. "
        f"`bodyschema scan --port {port}` looks at all rates"
    )


def editor_of(table: str) -> EepromEditor:
    """Return the EEPROM editor for servos of a vendor."""
    clock = SystemClock()

    def open_at(port: str, baud: int) -> tuple[SerialLine, float]:
        return SerialLine.open(port, baud, clock.now), adapter_latency_s(port)

    return EepromEditor(EEPROM_VENDORS[table][0], clock, open_at)


def entry_of(joint: str, id: int, model: Model) -> ServoConfig:
    """Return a servo as a robot.toml entry."""
    return ServoConfig(joint, id, model.name)


def settings_by_name(editor: EepromEditor, model: Model) -> Mapping[str, Setting]:
    return {setting.name: setting for setting in editor.vendor.settings(model)}


def model_called(table: str, name: str) -> Model:
    """Return the model of a vendor; raise ConfigError if this version does not know it."""
    models = EEPROM_VENDORS[table][1] if table in EEPROM_VENDORS else {}
    if name not in models:
        raise ConfigError(f"unknown model {name!r} of {table}", remedy=did_you_mean(name, models))
    return models[name]
