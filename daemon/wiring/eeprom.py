"""Wiring of `bodyschema servos`: the selected servos, and the editor that changes their EEPROM."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import msgspec

from bodyschema.daemon.config import Config
from bodyschema.drivers.dynamixel.config import Baud as DynamixelBaud
from bodyschema.drivers.dynamixel.config import BusConfig as DynamixelBus
from bodyschema.drivers.dynamixel.config import DynamixelConfig
from bodyschema.drivers.dynamixel.joints import DYNAMIXEL
from bodyschema.drivers.dynamixel.joints import open_serial as open_dynamixel
from bodyschema.drivers.feetech.config import Baud as FeetechBaud
from bodyschema.drivers.feetech.config import BusConfig as FeetechBus
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.feetech.joints import FEETECH
from bodyschema.drivers.feetech.joints import open_serial as open_feetech
from bodyschema.drivers.servos.config import ServoConfig
from bodyschema.drivers.servos.handshake import IdentifiedServo
from bodyschema.drivers.servos.model import Model
from bodyschema.drivers.servos.port import Port
from bodyschema.drivers.servos.settings import BAUD, HOMING_OFFSET, ID, Setting, setting_called
from bodyschema.drivers.servos.workbench import Change, Done, EepromEditor, Outcome
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, SourceError
from bodyschema.robot.suggest import did_you_mean

__all__ = [
    "BAUD",
    "HOMING_OFFSET",
    "ID",
    "Change",
    "Done",
    "EepromEditor",
    "IdentifiedServo",
    "Outcome",
    "Setting",
    "Wanted",
    "configured",
    "entry_of",
    "model_called",
    "setting_called",
    "settings_by_name",
    "stranger",
    "workbench_of",
]

STRANGER = "-"  # instead of a joint's name
TABLES = {"dynamixel": (DYNAMIXEL, DynamixelConfig), "feetech": (FEETECH, FeetechConfig)}


@dataclass(frozen=True, slots=True)
class Wanted:
    """A selected servo, before it is queried.

    Attributes:
        table: its vendor's table in [drivers].
    """

    table: str
    port: str
    baud: int
    entry: ServoConfig
    model: Model


def configured(config: Config, joints: Sequence[str], bus: str | None) -> list[Wanted]:
    """Return the servos of robot.toml that move `joints`, or all of a bus; all servos if neither is given.

    Raise ConfigError if there are none, or no such joint or bus.
    """
    tables = config.tables.drivers
    table = "dynamixel" if tables.dynamixel is not None else "feetech"
    servos = tables.dynamixel or tables.feetech
    if servos is None:
        remedy = "Add [drivers.dynamixel] or [drivers.feetech] (docs/hardware.md), or give --port and --id"
        raise ConfigError("no servos are configured", file=config.file, remedy=remedy)
    _require_known("joint", joints, config.robot.joints)
    _require_known("bus", [] if bus is None else [bus], servos.buses)
    found = []
    for entry in servos.servos:
        name = servos.bus_of(entry)
        if (not joints or entry.joint in joints) and bus in (None, name):
            place = servos.buses[name]
            found.append(Wanted(table, place.port, place.baud, entry, servos.model_of(entry)))
    if not found:
        raise ConfigError(f"none of these joints is on the bus {bus!r}", file=config.file, remedy="Drop --bus")
    return found


def bauds_of(table: str) -> Sequence[int]:
    """Return the baud rates that robot.toml accepts for a vendor [bit/s]."""
    return get_args(DynamixelBaud if table == "dynamixel" else FeetechBaud)


def stranger(port: str, baud: int, id: int) -> Wanted:
    """Return the servo of that ID, of any vendor, that robot.toml does not name. SourceError if there is no answer."""
    for table in [table for table in TABLES if baud in bauds_of(table)]:
        with workbench_of(table) as workbench:
            model = workbench.model_at(workbench.bus(port, baud), id)
        if model is not None:
            return Wanted(table, port, baud, entry_of(STRANGER, id, model), model)
    raise SourceError(
        f"no servo that we know answers to ID {id} on {port} at {baud:,} bit/s. "
        f"`bodyschema scan --port {port}` looks at all rates"
    )


def workbench_of(table: str) -> EepromEditor:
    """Return the EEPROM editor for servos of a vendor."""
    clock = SystemClock()
    openers = {"dynamixel": _open_dynamixel, "feetech": _open_feetech}
    return EepromEditor(TABLES[table][0], clock, lambda port, baud: openers[table](port, baud, clock))


def entry_of(joint: str, id: int, model: Model) -> ServoConfig:
    """Return a servo as a robot.toml entry."""
    return ServoConfig(joint, id, model.name)


def _open_dynamixel(port: str, baud: int, clock: SystemClock) -> tuple[Port, float]:
    return open_dynamixel(msgspec.convert({"port": port, "baud": baud}, DynamixelBus), clock)


def _open_feetech(port: str, baud: int, clock: SystemClock) -> tuple[Port, float]:
    return open_feetech(msgspec.convert({"port": port, "baud": baud}, FeetechBus), clock)


def settings_by_name(workbench: EepromEditor, model: Model) -> Mapping[str, Setting]:
    """Return the writable settings of a model."""
    return {setting.name: setting for setting in workbench.make.settings(model)}


def model_called(table: str, name: str) -> Model:
    """Return the model of a vendor. ConfigError if this version does not know it."""
    models = TABLES[table][1].models if table in TABLES else {}
    if name not in models:
        raise ConfigError(f"unknown model {name!r} of {table}", remedy=did_you_mean(name, models))
    return models[name]


def _require_known(what: str, names: Iterable[str], known: Iterable[str]) -> None:
    for name in names:
        if name not in list(known):
            raise ConfigError(f"unknown {what} {name!r}", remedy=did_you_mean(name, known))
