"""The wiring of the commands around servos: the configured arm on a bench, and its joints in the simulation's place."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from time import monotonic

from drivers import checks
from drivers.checks import Check, Holder
from drivers.dynamixel.bench.asked_faults import AskedFault
from drivers.dynamixel.bench.dry_run import DryRun
from drivers.bench.motion import played, swinging
from drivers.dynamixel.bench.servo import Angle
from drivers.dynamixel.bench.through_servos import ThroughServos
from drivers.dynamixel.checks import servo_checks as dynamixel_checks
from drivers.dynamixel.config import DynamixelConfig
from drivers.dynamixel.models import BY_NAME
from drivers.dynamixel.scan import SCANNERS
from drivers.scan import ScannedBus, Tell, scan_port, serial_ports
from drivers.serial_line import adapter_latency_s
from interfaces.clock import SystemClock
from interfaces.errors import ConfigError
from interfaces.protocols import JointSource
from interfaces.toml_file import read_toml
from interfaces.toml_text import toml_text

from .config import Config

PATH_S = 40.0  # of guided motion, played to and fro
MARK = "# Written by `bodyschema bench`, which removes it when it ends."
PSEUDO_TERMINALS = "/dev/pts/"


@dataclass(frozen=True, slots=True)
class Motion:
    """How the joints of a bench move: an angle at a time [rad] by joint, and that in words."""

    angles: dict[str, Angle]
    words: str


def require_servos(config: Config) -> DynamixelConfig:
    """The servos of robot.toml; ConfigError when it has none."""
    servos = config.tables.drivers.dynamixel
    if servos is None:
        raise ConfigError(
            "no servos are configured",
            file=config.file,
            remedy="Add the table [drivers.dynamixel] (docs/hardware.md), or let `bodyschema robot new` write it",
        )
    return servos


def limits_of(config: Config) -> list[tuple[float, float]]:
    """Of each joint [rad]."""
    return list(zip(config.robot.lower.tolist(), config.robot.upper.tolist(), strict=True))


def bench_motion(config: Config, tell: Callable[[float], None]) -> Motion:
    """The simulated hand's guidance where the simulation can run, else a slow swing of each joint.

    Args:
        tell: called with the share of the path that is made.
    """
    joints = config.robot.joints
    why = _no_simulation(config)
    if why:
        angles = swinging(limits_of(config), monotonic())
        return Motion(dict(zip(joints, angles, strict=True)), f"each joint swings slowly by itself ({why})")
    from sim_backend.guided_path import guided_path

    path = guided_path(config.robot, config.tables.sim, PATH_S, config.simulation, lambda done_s: tell(done_s / PATH_S))
    angles = played(path, config.tables.sim.encoders.rate_hz, monotonic())
    words = f"guided by the simulated hand, {PATH_S:.0f} s of path to and fro"
    return Motion(dict(zip(joints, angles, strict=True)), words)


def _no_simulation(config: Config) -> str:
    if find_spec("pybullet") is None:
        return "for a guided path: pip install 'bodyschema[sim]'"
    if config.robot.calibration is None:
        return "for a guided path describe the stereo pair in [camera]"
    return ""


def open_bench(
    config: Config, port: Path, motion: Motion, *, faults: Sequence[str] = (), return_delay_s: float, seed: int
) -> DryRun:
    """The servos that robot.toml describes behind `port`, or `port`-NAME for each of several buses; not opened yet.

    Raises:
        ConfigError: there are no servos, a fault is none, or something else is in the place of a port.
    """
    servos = require_servos(config)
    asked = [AskedFault.parsed(text, config.robot.joints) for text in faults]
    names = list(servos.buses)
    links = {name: port if len(names) == 1 else port.with_name(f"{port.name}-{name}") for name in names}
    for link in links.values():
        _require_free(link)
    return DryRun(servos, motion.angles, links, faults=asked, return_delay_s=return_delay_s, seed=seed)


def _require_free(link: Path) -> None:
    """ConfigError when something is there that no earlier bench left."""
    left_behind = link.is_symlink() and os.readlink(link).startswith(PSEUDO_TERMINALS)
    if not left_behind and os.path.lexists(link):
        raise ConfigError("is there already", file=link, remedy="Give another --port, a name that is not taken")
    if not link.parent.is_dir():
        raise ConfigError("there is no such folder", file=link.parent, remedy="Give another --port")


def bench_robot_file(config: Config, bench: DryRun, port: Path) -> Path:
    """Write robot.toml anew beside `port`: with the bench's ports, and a state of its own.

    Raises:
        ConfigError: another file is there, or it cannot be written.
    """
    file = port.with_name(f"{port.name}.toml")
    tables, _ = read_toml(config.file)
    tables["robot"]["urdf"] = str(config.robot.tree.file.resolve())
    for name, bus in bench.config.buses.items():
        tables["drivers"]["dynamixel"]["buses"][name]["port"] = str(Path(bus.port).absolute())
    tables.setdefault("daemon", {})["state_dir"] = str(port.with_name(f"{port.name}.state").absolute())
    if "unexplained" in tables:
        tables["unexplained"]["model"] = str((config.file.parent / tables["unexplained"]["model"]).resolve())
    try:
        if file.exists() and not file.read_text(encoding="utf-8").startswith(MARK):
            raise ConfigError("is there already, and no bench wrote it", file=file, remedy="Give another --port")
        file.write_text(f"{MARK}\n{toml_text(tables)}", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=file, remedy="Give another --port") from error
    return file


def through_servos(config: Config, joints: JointSource) -> JointSource:
    """The simulation's joints, read from servos on a bench."""
    return ThroughServos(joints, require_servos(config), SystemClock(), limits_of(config))


def known_models() -> list[str]:
    """The servos that there are drivers for, by name."""
    return sorted(BY_NAME)


def scanned_bauds() -> list[int]:
    """The rates at which somebody may be [bit/s]."""
    return sorted({baud for scanner in SCANNERS for baud in scanner.bauds})


def ports_to_scan(given: Sequence[str], config: Config | None) -> list[str]:
    """The ports that were given; else those of robot.toml, and all USB serial ports, each once.

    Raises:
        ConfigError: there are none.
    """
    if given:
        return list(given)
    servos = None if config is None else config.tables.drivers.dynamixel
    ports = [] if servos is None else [bus.port for bus in servos.buses.values()]
    found = {os.path.realpath(port): port for port in [*serial_ports(), *ports]}
    if not found:
        raise ConfigError(
            "there is no USB serial port on this machine",
            remedy="Plug the adapter in and look at `ls /dev/serial/by-id`, or name another port with --port",
        )
    return list(found.values())


def scan(ports: Sequence[str], bauds: Sequence[int], tell: Tell) -> list[ScannedBus]:
    """Who is there, port by port, at all rates or at `bauds`."""
    clock = SystemClock()
    return [scan_port(port, SCANNERS, clock, tell, bauds=bauds, latency_s=adapter_latency_s(port)) for port in ports]


def port_checks(config: Config, ours: Collection[int] = ()) -> Iterator[Check]:
    """Of each port of robot.toml: is it there, may it be opened, who has it? `ours` are processes that may have it."""
    for name, bus in require_servos(config).buses.items():
        yield from checks.port_checks(name, bus.port, ours=ours)


def ports_are_there(config: Config) -> bool:
    """Whether all ports of robot.toml are."""
    return all(os.path.exists(bus.port) for bus in require_servos(config).buses.values())


def other_holders(config: Config) -> list[Holder]:
    """The other processes that have one of the ports open."""
    return [holder for bus in require_servos(config).buses.values() for holder in checks.holders(bus.port)]


def servo_checks(config: Config) -> Iterator[Check]:
    """Of the servos of robot.toml: who is there, how they are, how fast they are read. Writes nothing."""
    yield from dynamixel_checks(require_servos(config), SystemClock())
