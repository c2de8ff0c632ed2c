"""Show a scan's report in a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bodyschema.interfaces.servos import FoundServo

from .scan_report import ScanReport

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
            _or_dash(servo.voltage_v, "{:.1f} V"),
            _or_dash(servo.temperature_c, "{:.0f} °C"),
            "-" if servo.has_torque is None else "on" if servo.has_torque else "off",
        ]
        table.add_row(*cells, *([joints.get(id(servo), "-")] if named else []))
    return table


def _rate(baud: int) -> str:
    return f"{baud / 1e6:g} M" if baud >= 1e6 else f"{baud / 1e3:g} k"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)


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
