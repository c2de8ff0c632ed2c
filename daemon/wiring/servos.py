"""Wiring of the commands that find servos, of all protocols, and report their health."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

from bodyschema.drivers import checks
from bodyschema.drivers.checks import Check, Holder
from bodyschema.drivers.dynamixel.bus import PROTOCOL1, Protocol2Scanner
from bodyschema.drivers.dynamixel.config import Baud as DynamixelBaud
from bodyschema.drivers.dynamixel.config import DynamixelConfig
from bodyschema.drivers.dynamixel.joints import DYNAMIXEL
from bodyschema.drivers.feetech.config import Baud as FeetechBaud
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.feetech.joints import FEETECH, FEETECH_SERVOS
from bodyschema.drivers.serial_line import adapter_latency_s, serial_ports
from bodyschema.drivers.serial_lines.joints import encoder_checks as checks_of_encoders
from bodyschema.drivers.servos.checks import servo_checks as checks_of_servos
from bodyschema.drivers.servos.scan import PingScanner, ScannedBus, Tell, scan_port
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError

if TYPE_CHECKING:
    from bodyschema.daemon.config import Config

# PING is the same in Protocol 1.0 and in Feetech's protocol: one scan finds both.
SCANNERS = (Protocol2Scanner(), PingScanner(PROTOCOL1, FEETECH_SERVOS))

VENDORS = {vendor.table: vendor for vendor in (DYNAMIXEL, FEETECH)}
Servos = DynamixelConfig | FeetechConfig


@dataclass(frozen=True, slots=True)
class KnownModel:
    """A servo model with a driver."""

    table: str  # its vendor's table in [drivers]
    bauds: tuple[int, ...]  # the baud rates that robot.toml accepts for it [bit/s]
    zero_ticks: int  # the middle of its range


def servos_of(config: Config) -> Servos | None:
    """Return the servos of robot.toml, or None if it has none."""
    return config.tables.drivers.dynamixel or config.tables.drivers.feetech


def require_servos(config: Config) -> Servos:
    """Return the servos of robot.toml; raise ConfigError if it has none."""
    servos = servos_of(config)
    if servos is None:
        raise ConfigError(
            "no servos are configured",
            file=config.file,
            remedy="Add the table [drivers.dynamixel] or [drivers.feetech] (docs/hardware.md), "
            "or let `bodyschema init --from scan` write it",
        )
    return servos


def known_models() -> dict[str, KnownModel]:
    """Return the servo models that have a driver, by name."""
    return {
        model.name: KnownModel(vendor.table, get_args(baud), model.zero_ticks)
        for vendor, baud in ((DYNAMIXEL, DynamixelBaud), (FEETECH, FeetechBaud))
        for model in vendor.models.values()
    }


def scanned_bauds() -> list[int]:
    """Return the baud rates to scan [bit/s]."""
    return sorted({baud for scanner in SCANNERS for baud in scanner.bauds})


def ports_to_scan(given: Sequence[str], config: Config | None) -> list[str]:
    """Return the given ports; otherwise those of robot.toml and all USB serial ports, each once.

    Raises:
        ConfigError: there are none.
    """
    if given:
        return list(given)
    servos = None if config is None else servos_of(config)
    ports = [] if servos is None else [bus.port for bus in servos.buses.values()]
    found = {os.path.realpath(port): port for port in [*serial_ports(), *ports]}
    if not found:
        raise ConfigError(
            "there is no USB serial port on this machine",
            remedy="Plug the adapter in and look at `ls /dev/serial/by-id`, or name another port with --port",
        )
    return list(found.values())


def scan(ports: Sequence[str], bauds: Sequence[int], tell: Tell) -> list[ScannedBus]:
    """Scan port by port, at all rates or at `bauds`."""
    clock = SystemClock()
    return [scan_port(port, SCANNERS, clock, tell, bauds=bauds, latency_s=adapter_latency_s(port)) for port in ports]


def configured_ports(config: Config) -> dict[str, str]:
    """Return the serial ports of robot.toml, by name."""
    servos, lines = servos_of(config), config.tables.drivers.serial_lines
    if lines is not None:
        return {"board": lines.port}
    return {} if servos is None else {name: bus.port for name, bus in servos.buses.items()}


def port_checks(config: Config, ours: Collection[int] = ()) -> Iterator[Check]:
    """Check each port of robot.toml: existence, permissions, other users. `ours` are processes that may use it."""
    for name, port in configured_ports(config).items():
        yield from checks.port_checks(name, port, ours=ours)


def other_holders(config: Config) -> list[Holder]:
    """Return the other processes that have one of the ports open."""
    return [holder for port in configured_ports(config).values() for holder in checks.holders(port)]


def servo_checks(config: Config) -> Iterator[Check]:
    """Check the servos of robot.toml: presence, health, reading rate. Writes nothing."""
    servos = require_servos(config)
    yield from checks_of_servos(VENDORS[servos.table], servos, SystemClock())


def encoder_checks(config: Config) -> Iterator[Check]:
    """Check the encoders of robot.toml on a board, if it has any."""
    board = config.tables.drivers.serial_lines
    if board is not None:
        yield from checks_of_encoders(board, config.robot.joints, SystemClock())


def joint_state_checks(config: Config) -> Iterator[Check]:
    """Check the ROS 2 robot of robot.toml, if it has one. Only listens."""
    robot = config.tables.drivers.ros2
    if robot is not None:
        from bodyschema.drivers.ros2.joints import joint_state_checks as checks_of_joint_states

        prismatic = config.robot.chain.prismatic.tolist()
        yield from checks_of_joint_states(robot, config.robot.joints, SystemClock(), prismatic=prismatic)
