"""The wiring of emulated arms: the arm of robot.toml without hardware, alone or instead of the simulation."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any

import msgspec

from bodyschema.daemon.config import Config
from bodyschema.drivers.dynamixel.config import DynamixelConfig
from bodyschema.drivers.emulator.device import Angle
from bodyschema.drivers.emulator.dry_run import DryRun, DryRunArm
from bodyschema.drivers.emulator.faults import FaultSpec
from bodyschema.drivers.emulator.servo_arm import played, swinging
from bodyschema.drivers.emulator.through_driver import Behind, ThroughDriver, ThroughDriverSettings
from bodyschema.drivers.feetech.config import FeetechConfig
from bodyschema.drivers.ros2.config import Ros2Config
from bodyschema.drivers.serial_lines.config import SerialLinesConfig
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.extras import install_command, no_pybullet
from bodyschema.interfaces.protocols import JointSource
from bodyschema.interfaces.records import JointReading
from bodyschema.interfaces.whole_files import raising_write_errors
from bodyschema.robot.limited import read_at_most
from bodyschema.robot.toml_file import read_toml
from bodyschema.robot.toml_text import toml_text

from .simulation import simulation_settings


class _Settings:
    path_s: float = 40.0  # of guided motion, played to and fro
    board_rate_hz, board_baud = 500.0, 921_600  # of a board in the simulation's place, which waits for each line
    settled_s: float = 2e-3  # how far off the time of a line may be


MARK = "# Written by `bodyschema emulate`, which removes it when it ends."
PSEUDO_TERMINALS = "/dev/pts/"

OnPorts = DynamixelConfig | FeetechConfig | SerialLinesConfig


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of an emulated arm: the angle [rad] of each joint as a function of time, and a description in words."""

    angles: dict[str, Angle]
    words: str


def require_on_ports(config: Config) -> OnPorts:
    """Return the servos or encoders of robot.toml; raise ConfigError if it has none."""
    match config.tables.drivers.hardware:
        case DynamixelConfig() | FeetechConfig() | SerialLinesConfig() as hardware:
            return hardware
    raise ConfigError(
        "no servos are configured, and no encoders",
        file=config.file,
        remedy="Add the table [drivers.dynamixel], [drivers.feetech] or [drivers.serial_lines] (docs/hardware.md), "
        "or let `bodyschema init --from scan` write it",
    )


def emulated_motion(config: Config, tell: Callable[[float], None]) -> Motion:
    """Return a motion guided by the simulated hand; without the simulation, a slow swing of each joint.

    Args:
        tell: called with the fraction of the path that is computed.
    """
    joints = config.robot.joints
    why = _no_simulation(config)
    if why:
        angles = swinging(config.robot.limits, monotonic())
        return Motion(dict(zip(joints, angles, strict=True)), f"each joint swings slowly by itself ({why})")
    from bodyschema.sim_backend.world import guided_path

    sim = simulation_settings(config)
    path = guided_path(
        config.robot, sim, _Settings.path_s, config.simulation, lambda done_s: tell(done_s / _Settings.path_s)
    )
    angles = played(path, sim.encoders.rate_hz, monotonic())
    words = f"guided by the simulated hand, {_Settings.path_s:.0f} s of path to and fro"
    return Motion(dict(zip(joints, angles, strict=True)), words)


def _no_simulation(config: Config) -> str:
    if find_spec("pybullet") is None:
        return f"for a guided path: {no_pybullet() or install_command('sim')}"
    if config.robot.calibration is None:
        return "for a guided path describe the cameras in [camera]"
    return ""


def open_emulator(
    config: Config, port: Path, motion: Motion, *, faults: Sequence[str] = (), return_delay_s: float, seed: int
) -> DryRun:
    """Return the arm of robot.toml behind `port` (several buses: each at `port`-NAME), not opened yet.

    Raises:
        ConfigError: no servos or encoders are configured, a fault is invalid, or a port's path is occupied.
    """
    hardware = require_on_ports(config)
    make = _arm_of(hardware)
    asked = [FaultSpec.parsed(text, config.robot.joints, make.kinds) for text in faults]
    if not isinstance(hardware, SerialLinesConfig):
        make = partial(make, return_delay_s=return_delay_s)
    arm = make(hardware, motion.angles, faults=asked, seed=seed)
    names = list(arm.devices)
    links = {name: port if len(names) == 1 else port.with_name(f"{port.name}-{name}") for name in names}
    for link in links.values():
        _require_free(link)
    return DryRun(arm, links, faults=asked)


def _arm_of(hardware: OnPorts) -> Any:
    """Return the class of the emulated arm, a `DryRunArm`."""
    match hardware:
        case DynamixelConfig():
            from bodyschema.drivers.dynamixel.emulator.arm import DynamixelArm as Arm
        case FeetechConfig():
            from bodyschema.drivers.feetech.emulator.arm import FeetechArm as Arm
        case SerialLinesConfig():
            from bodyschema.drivers.serial_lines.emulator.arm import EncoderArm as Arm
    return Arm


def emulated_ports(emulator: DryRun) -> list[str]:
    """Return a line on the devices of each port."""
    match emulator.config:
        case SerialLinesConfig() as config:
            return [f"{_plural(len(config.encoders), 'encoder')} on {config.port} at {config.baud:,} bit/s"]
        case config:
            fitted = {name: sum(config.bus_of(servo) == name for servo in config.servos) for name in config.buses}
            return [
                f"{_plural(fitted[name], 'servo')} on {bus.port} at {bus.baud:,} bit/s"
                for name, bus in config.buses.items()
            ]


def emulate_commands(emulator: DryRun) -> tuple[str, ...]:
    """Return the names of the commands that can talk to the devices on the ports."""
    common = ("doctor", "watch joints")
    return common if isinstance(emulator.config, SerialLinesConfig) else ("scan", *common)


def _plural(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _require_free(link: Path) -> None:
    """Raise ConfigError unless the path is free, or a link of an earlier emulator whose terminal is closed."""
    is_of_emulator = link.is_symlink() and os.readlink(link).startswith(PSEUDO_TERMINALS)
    if is_of_emulator and link.exists():
        remedy = f"Give another --port, or end that emulator. If none runs: rm {link}"
        raise ConfigError("another emulator has this port", file=link, remedy=remedy)
    if not is_of_emulator and os.path.lexists(link):
        raise ConfigError("is there already", file=link, remedy="Give another --port, a name that is not taken")
    if not link.parent.is_dir():
        raise ConfigError("there is no such folder", file=link.parent, remedy="Give another --port")


def emulator_robot_file(config: Config, emulator: DryRun, port: Path) -> Path:
    """Write a copy of robot.toml beside `port`, with the emulator's ports and its own state.

    Raises:
        ConfigError: another file is there, or it cannot be written.
    """
    file = port.with_name(f"{port.name}.toml")
    tables, _ = read_toml(config.file)
    tables["robot"]["urdf"] = str(config.robot.tree.file.resolve())
    match emulator.config:
        case SerialLinesConfig() as board:
            tables["drivers"]["serial_lines"]["port"] = str(Path(board.port).absolute())
        case servos:
            for name, bus in servos.buses.items():
                tables["drivers"][servos.table]["buses"][name]["port"] = str(Path(bus.port).absolute())
    tables.setdefault("daemon", {})["state_dir"] = str(port.with_name(f"{port.name}.state").absolute())
    if "unexplained" in tables:
        tables["unexplained"]["model"] = str((config.file.parent / tables["unexplained"]["model"]).resolve())
    with raising_write_errors(file, remedy="Give another --port"):
        if file.exists() and not read_at_most(file).startswith(MARK.encode()):
            raise ConfigError("is there already, and no emulator wrote it", file=file, remedy="Give another --port")
        file.write_text(f"{MARK}\n{toml_text(tables)}", encoding="utf-8")
    return file


# --- in the simulation's place


def require_emulator(config: Config) -> OnPorts | Ros2Config:
    """Return the driver settings for reading the simulation's joints; raise ConfigError if robot.toml has none."""
    robot = config.tables.drivers.ros2
    return require_on_ports(config) if robot is None else robot


OpenDriver = Callable[[OnPorts | Ros2Config], JointSource]


def through_emulator(config: Config, joints: JointSource, open_driver: OpenDriver) -> JointSource:
    """Return the simulation's joints, read from an emulator by the driver configured in robot.toml."""
    hardware = require_emulator(config)
    match hardware:
        case DynamixelConfig() | FeetechConfig():
            return ThroughDriver(joints, lambda angles: _looking_at_servos(hardware, angles, open_driver))
        case SerialLinesConfig():
            return ThroughDriver(joints, lambda angles: _looking_at_lines(hardware, angles, open_driver))
        case Ros2Config():
            return ThroughDriver(joints, lambda angles: _looking_at_messages(hardware, angles, open_driver))


@contextmanager
def _looking_at_servos(
    hardware: DynamixelConfig | FeetechConfig, angles: Mapping[str, Angle], open_driver: OpenDriver
) -> Iterator[Behind]:
    buses = {
        name: msgspec.structs.replace(bus, latency_ms=ThroughDriverSettings.latency_ms)
        for name, bus in hardware.buses.items()
    }
    patient = msgspec.structs.replace(hardware, buses=buses)
    with _on_emulator(_arm_of(patient)(patient, angles)) as emulator, open_driver(emulator.config) as servos:
        yield Behind(servos, lambda: servos.read(ThroughDriverSettings.read_s))


@contextmanager
def _looking_at_lines(
    hardware: SerialLinesConfig, angles: Mapping[str, Angle], open_driver: OpenDriver
) -> Iterator[Behind]:
    """Yield joints read from an emulated board; each read waits for a line measured after it."""
    from bodyschema.drivers.serial_lines.emulator.board import Listener

    clock = SystemClock()
    quick = msgspec.structs.replace(hardware, baud=_Settings.board_baud, delay_ms=0.0, native_usb=False)
    arm = _arm_of(quick)(quick, angles, rate_hz=_Settings.board_rate_hz)
    with _on_emulator(arm) as emulator, open_driver(emulator.config) as encoders, Listener(encoders) as listener:
        yield Behind(encoders, lambda: listener.after(clock.now() + _Settings.settled_s, ThroughDriverSettings.read_s))


@contextmanager
def _looking_at_messages(
    hardware: Ros2Config, angles: Mapping[str, Angle], open_driver: OpenDriver
) -> Iterator[Behind]:
    """Yield joints read from a node and a router in this process; the node publishes at each read."""
    from bodyschema.drivers.ros2.emulator.node import Node
    from bodyschema.drivers.ros2.emulator.zenoh_robot import ZenohRobot

    clock = SystemClock()
    node = Node(dict(zip(hardware.ros_names(tuple(angles)), angles.values(), strict=True)), rate_hz=1.0)
    with socket.create_server(("127.0.0.1", 0)) as free:
        router = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    here = msgspec.structs.replace(hardware, router=router)
    with ZenohRobot([node], router, domain=here.domain, topic=here.topic) as robot, open_driver(here) as joints:

        def look() -> JointReading | None:
            robot.publish(node, clock.now())
            return joints.read(ThroughDriverSettings.read_s)

        yield Behind(joints, look)


@contextmanager
def _on_emulator(arm: DryRunArm) -> Iterator[DryRun]:
    with (
        TemporaryDirectory(prefix="bodyschema-emulator-") as folder,
        DryRun(arm, {name: Path(folder) / name for name in arm.devices}) as emulator,
    ):
        yield emulator
