"""Compare the result of a scan with robot.toml."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from bodyschema.daemon.wiring.servos import known_models, require_servos
from bodyschema.interfaces.servos import FoundServo, ScannedBus

if TYPE_CHECKING:
    from bodyschema.daemon.config import Config


@dataclass(frozen=True, slots=True)
class JointFinding:
    """The finding for a servo of robot.toml.

    Attributes:
        state: "ok", "missing", "wrong model", "not known" (it does not report its model), "another rate", "another
            port" or "double".
        fix: remedy; empty if the state is ok.
        servo: the servo that answered; None if there was no answer.
    """

    joint: str
    bus: str
    id: int
    model: str
    state: str
    fix: str = ""
    servo: FoundServo | None = None


@dataclass(frozen=True, slots=True)
class ScanReport:
    """All ports, compared with robot.toml.

    Attributes:
        joints: finding for each servo of robot.toml; None without a robot.toml.
        strangers: servos on its ports that robot.toml does not name.
        cameras: this machine's cameras, by their names in robot.toml.
    """

    ports: Sequence[ScannedBus]
    joints: tuple[JointFinding, ...] | None = None
    strangers: tuple[FoundServo, ...] = ()
    cameras: tuple[str, ...] = ()

    @property
    def servos(self) -> list[FoundServo]:
        """All servos found."""
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
        wanted = servos.buses[bus]
        state, fix, servo = _place(found, entry.id, entry.model, wanted.port, wanted.baud)
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
    if here:
        return "wrong model", _for_model(here[0].model, model), here[0]
    elsewhere = [servo for servo in found if servo.id == id and servo.model == model]
    if elsewhere:
        return "another port", f'set port = "{elsewhere[0].port}" in robot.toml', elsewhere[0]
    return "missing", "look at its supply and cable, and those of the one before it", None


def _for_model(found: str | None, wanted: str) -> str:
    """Return the remedy for a servo of another model."""
    if found in known_models():
        return f'set model = "{found}" in robot.toml, or give the servo another ID'
    return f"it is a {found}, which no driver reads: put a {wanted} in its place, or give it another ID"


def as_json(report: ScanReport) -> str:
    """Return the report as JSON: `ports` with `servos`, `cameras`, and with a robot.toml `joints` and `strangers`."""
    contents: dict[str, Any] = {"schema": 1, "well": report.is_well, "ports": report.ports, "cameras": report.cameras}
    if report.joints is not None:
        contents |= {"joints": report.joints, "strangers": report.strangers}
    return msgspec.json.format(msgspec.json.encode(contents)).decode()
