"""Compare the result of a scan with robot.toml."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bodyschema.cli.terminal.screen import or_dash
from bodyschema.daemon.wiring.servos import known_models, require_servos
from bodyschema.interfaces.servos import FoundServo, ScannedBus

if TYPE_CHECKING:
    from bodyschema.daemon.config import Config


@dataclass(frozen=True, slots=True)
class JointFinding:
    """The finding for a servo of robot.toml."""

    joint: str
    bus: str
    id: int
    model: str
    # "ok", "missing", "wrong model", "not known" (it does not report its model), "another rate", "another port" or
    # "double"
    state: str
    fix: str = ""  # remedy; empty if the state is ok
    servo: FoundServo | None = None  # the servo that answered; None if there was no answer


@dataclass(frozen=True, slots=True)
class ScanReport:
    """All ports, compared with robot.toml."""

    ports: Sequence[ScannedBus]
    joints: tuple[JointFinding, ...] | None = None  # finding for each servo of robot.toml; None without a robot.toml
    strangers: tuple[FoundServo, ...] = ()  # servos on its ports that robot.toml does not name
    cameras: tuple[str, ...] = ()  # this machine's cameras, by their names in robot.toml

    @property
    def servos(self) -> list[FoundServo]:
        return [servo for port in self.ports for servo in port.servos]

    @property
    def is_well(self) -> bool:
        """True if every port answered, and if there is a robot.toml, exactly its servos were found."""
        if any(port.trouble for port in self.ports) or not self.servos or any(s.is_double for s in self.servos):
            return False
        return self.joints is None or (not self.strangers and all(joint.state == "ok" for joint in self.joints))


def report_of(ports: Sequence[ScannedBus], config: Config | None) -> ScanReport:
    """Return the report; without `config`, of the ports alone.

    Raises:
        ConfigError: robot.toml has no servos.
    """
    if config is None:
        return ScanReport(ports)
    servos, found = require_servos(config), [servo for port in ports for servo in port.servos]
    joints: list[JointFinding] = []
    for entry in servos.servos:
        bus = servos.bus_of(entry)
        configured = servos.buses[bus]
        state, fix, servo = _place(found, entry.id, entry.model, configured.port, configured.baud)
        joints.append(JointFinding(entry.joint, bus, entry.id, entry.model, state, fix, servo))
    known = {id(joint.servo) for joint in joints}
    own = {os.path.realpath(bus.port) for bus in servos.buses.values()}
    strangers = [servo for servo in found if id(servo) not in known and os.path.realpath(servo.port) in own]
    return ScanReport(ports, tuple(joints), tuple(strangers))


def _place(
    found: Sequence[FoundServo], id: int, model: str, port: str, baud: int
) -> tuple[str, str, FoundServo | None]:
    """Return state, remedy and servo for a servo that should be on `port` at `baud`."""
    here = [servo for servo in found if servo.id == id and os.path.realpath(servo.port) == os.path.realpath(port)]
    if any(servo.is_double for servo in here) or len([servo for servo in here if servo.baud == baud]) > 1:
        return "double", "two servos have this ID: take one off, give the other another ID", here[0]
    right = [servo for servo in here if servo.baud == baud and servo.model == model]
    if right:
        return "ok", "", right[0]
    if here and here[0].baud != baud:
        return "another rate", f"give the servo {baud:,} bit/s, or set baud = {here[0].baud} in robot.toml", here[0]
    if here and here[0].model is None:
        return "not known", "it does not report its model: correct its entry", here[0]
    if here and here[0].model in known_models():
        fix = f'set model = "{here[0].model}" in robot.toml, or give the servo another ID'
        return "wrong model", fix, here[0]
    if here:
        fix = f"it is a {here[0].model}, which no driver reads: put a {model} in its place, or give it another ID"
        return "wrong model", fix, here[0]
    elsewhere = [servo for servo in found if servo.id == id and servo.model == model]
    if elsewhere:
        return "another port", f'set port = "{elsewhere[0].port}" in robot.toml', elsewhere[0]
    return "missing", "look at its supply and cable, and those of the one before it", None


def as_json(report: ScanReport) -> str:
    """Return the report as JSON: `ports` with `servos`, `cameras`, and with a robot.toml `joints` and `strangers`."""
    contents: dict[str, Any] = {"schema": 1, "well": report.is_well, "ports": report.ports, "cameras": report.cameras}
    if report.joints is not None:
        contents |= {"joints": report.joints, "strangers": report.strangers}
    return msgspec.json.format(msgspec.json.encode(contents)).decode()


HEADINGS = ("ID", "model", "fw", "protocol", "bit/s", "supply", "temp.", "torque", "joint")
RIGHT = ("ID", "fw", "bit/s", "supply", "temp.")


def show(console: Console, report: ScanReport) -> None:
    """Print a table for each port, then the problems."""
    joints = {id(joint.servo): joint.joint for joint in report.joints or () if joint.servo is not None}
    for port in report.ports:
        console.print(Text(port.port, style="bold"), soft_wrap=True)
        if port.servos:
            console.print(_table(port.servos, joints, named=report.joints is not None))
        elif port.trouble is None:
            console.print("  no answer at any rate")
        if port.trouble is not None:
            console.print(Text(f"  {port.trouble}", style="red"), soft_wrap=True)
    for camera in report.cameras:
        console.print(Text(f"camera {camera}"), soft_wrap=True)
    troubles = list(_troubles(report))
    for line in troubles:
        console.print(Text(line, style="yellow"), soft_wrap=True)
    console.print(_verdict(report, troubles), markup=False, soft_wrap=True)


def _table(servos: Sequence[FoundServo], joints: dict[int, str], *, named: bool) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0), header_style="dim")
    for heading in HEADINGS if named else HEADINGS[:-1]:
        table.add_column(heading, justify="right" if heading in RIGHT else "left", no_wrap=True)
    for servo in servos:
        cells = [
            str(servo.id),
            servo.model or "?",
            servo.firmware or "-",
            servo.protocol,
            _rate(servo.baud),
            or_dash(servo.voltage_v, "{:.1f} V"),
            or_dash(servo.temperature_c, "{:.0f} °C"),
            "-" if servo.has_torque is None else "on" if servo.has_torque else "off",
        ]
        table.add_row(*cells, *([joints.get(id(servo), "-")] if named else []))
    return table


def _rate(baud: int) -> str:
    return f"{baud / 1e6:g} M" if baud >= 1e6 else f"{baud / 1e3:g} k"


def _troubles(report: ScanReport) -> Iterator[str]:
    for servo in report.servos:
        for trouble in servo.troubles:
            yield f"ID {servo.id}: {trouble}"
    for joint in report.joints or ():
        if joint.state not in ("ok", "double"):
            yield f"joint {joint.joint} (ID {joint.id}, {joint.model}): {joint.state}: {joint.fix}"
    for servo in report.strangers:
        yield f"ID {servo.id} ({servo.model or '?'}) is on a port of robot.toml, but not in it"


def _verdict(report: ScanReport, troubles: Sequence[str]) -> str:
    count = len(report.servos)
    servos = f"{count} servo{'' if count == 1 else 's'}"
    if not count:
        return "No servo answers. Look at the supply, the cable, and whether another program holds the port."
    if report.joints is None:
        return f"{servos} found. `bodyschema init --urdf YOUR.urdf --from scan` writes a robot.toml with them."
    if report.is_well:
        return f"{servos}: those of robot.toml, all of them{', with troubles' if troubles else ''}."
    right = sum(joint.state == "ok" for joint in report.joints)
    return f"{right} of {len(report.joints)} servos of robot.toml are as they should be."
