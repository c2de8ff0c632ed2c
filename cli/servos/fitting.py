"""Assign servos to joints, and write the corresponding tables of robot.toml."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from bodyschema.daemon.wiring.servos import KnownModel, known_models
from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.limited import read_at_most
from bodyschema.robot.toml_text import toml_value


class Candidate(msgspec.Struct, frozen=True):
    """A servo that answered, in the form of `bodyschema scan --json`."""

    port: str
    baud: int
    id: int
    model: str | None = None
    is_double: bool = False

    @property
    def is_usable(self) -> bool:
        """True if no other servo has its ID, its model is known, and robot.toml accepts its baud rate."""
        known = known_models().get(self.model or "")
        return not self.is_double and known is not None and self.baud in known.bauds


class _Bus(msgspec.Struct, frozen=True):
    servos: tuple[Candidate, ...]


class _Scan(msgspec.Struct, frozen=True):
    ports: tuple[_Bus, ...]


@dataclass(frozen=True, slots=True)
class Fitting:
    """Assignment of servos to joints."""

    servos: dict[str, Candidate]  # by joint, in the order of the joints
    bare: tuple[str, ...]  # joints without a servo
    left: tuple[Candidate, ...]  # servos without a joint


Choose = Callable[[str, Sequence[Candidate]], Candidate | None]


def candidates_in(json: bytes, file: object) -> list[Candidate]:
    """Return the servos of a saved scan; raise ConfigError if it is not a scan."""
    try:
        scan = msgspec.json.decode(json, type=_Scan)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(
            f"is no scan: {error}", file=file, remedy="Write one: bodyschema scan --json > FILE.json"
        ) from error
    return [servo for bus in scan.ports for servo in bus.servos]


def first_of(_joint: str, left: Sequence[Candidate]) -> Candidate | None:
    """Return the servo with the lowest ID, since arms are numbered from the base."""
    return left[0] if left else None


def fit(joints: Sequence[str], candidates: Sequence[Candidate], choose: Choose) -> Fitting:
    """Assign a servo to each joint; raise ConfigError if none of them can be used, or no joint got one."""
    left = sorted((c for c in candidates if c.is_usable), key=lambda c: (c.port, c.id))
    if not left:
        raise ConfigError(
            "no servo was found that can be used", remedy="`bodyschema scan` shows who answers, and why not"
        )
    servos: dict[str, Candidate] = {}
    for joint in joints:
        chosen = choose(joint, left)
        if chosen is not None:
            servos[joint] = chosen
            left.remove(chosen)
    if not servos:
        raise ConfigError("no joint got a servo", remedy="Give at least one of them one")
    return Fitting(servos, tuple(joint for joint in joints if joint not in servos), tuple(left))


def servo_tables(fitting: Fitting) -> str:
    """Return the tables [drivers.dynamixel...] or [drivers.feetech...] of robot.toml, with comments.

    Raises:
        ConfigError: the servos are of two vendors, or those on one port have different baud rates.
    """
    servos, known = list(fitting.servos.values()), known_models()
    vendor = _vendor(servos)
    names = _bus_names(servos)
    lines = ["", "# The servos, as `bodyschema scan` found them. docs/hardware.md has all keys."]
    for (port, baud), name in names.items():
        lines += [f"[drivers.{vendor.table}.buses.{name}]", f"port = {toml_value(port)}", f"baud = {baud:_}", ""]
    lines.append("# CHECK each with `bodyschema watch joints`: move the joint, and look where its angle goes.")
    for joint, servo in fitting.servos.items():
        lines += [f"[[drivers.{vendor.table}.servos]]", f"joint = {toml_value(joint)}", f"id = {servo.id}"]
        lines.append(f"model = {toml_value(servo.model or '')}")
        if len(names) > 1:
            lines.append(f"bus = {toml_value(names[servo.port, servo.baud])}")
        zero_ticks = f"# zero_ticks = {known[servo.model or ''].zero_ticks}"
        lines += [
            "# direction = -1      # the joint counts against the servo",
            f"{zero_ticks:22}# where it is at 0",
            "",
        ]
    return "\n".join(lines)


def _vendor(servos: Sequence[Candidate]) -> KnownModel:
    """Return the properties that the models of all `servos` share."""
    known = known_models()
    vendors = {known[servo.model or ""].table: known[servo.model or ""] for servo in servos}
    if len(vendors) > 1:
        tables = " and ".join(f"drivers.{table}" for table in vendors)
        raise ConfigError(
            f"the servos are of two vendors, {tables}, and an arm is of one",
            remedy="Give --port with the port of one of them, or - for the other's joints",
        )
    return next(iter(vendors.values()))


def _bus_names(servos: Sequence[Candidate]) -> dict[tuple[str, int], str]:
    buses = dict.fromkeys((servo.port, servo.baud) for servo in servos)
    taken: dict[str, int] = {}
    for port, baud in buses:
        if taken.setdefault(os.path.realpath(port), baud) != baud:
            raise ConfigError(f"the servos on {port} have different rates", remedy=_other_rates(servos, port))
    return {bus: "arm" if len(buses) == 1 else f"bus{place}" for place, bus in enumerate(buses, 1)}


def _other_rates(servos: Sequence[Candidate], port: str) -> str:
    """Return instructions to set all servos of a port to the baud rate that most of them have."""
    here = [servo for servo in servos if os.path.realpath(servo.port) == os.path.realpath(port)]
    most, _ = Counter(servo.baud for servo in here).most_common(1)[0]
    commands = [
        f"bodyschema servos baud={most} --port {port} --id {servo.id} --baud {servo.baud}"
        for servo in here
        if servo.baud != most
    ]
    return f"Give all the same: {'; '.join(commands)}; then scan again"


def read_scan(file: Path) -> list[Candidate]:
    """Return the servos in a file that `bodyschema scan --json` wrote.

    Raises:
        ConfigError: it cannot be read, or is not a scan.
    """
    try:
        return candidates_in(read_at_most(file), file)
    except OSError as error:
        remedy = "Write one: bodyschema scan --json > FILE.json"
        raise ConfigError(f"cannot be read: {error.strerror}", file=file, remedy=remedy) from error
