"""`bodyschema scan`."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from bodyschema.cli.commands.options import flag, several
from bodyschema.interfaces.errors import ConfigError


def scan(
    *,
    port: Annotated[tuple[str, ...], several("Only this port")] = (),
    baud: Annotated[tuple[int, ...], several("Only at this rate")] = (),
    robot: Annotated[
        Path | None, Parameter(help="Hold what is found against this robot.toml.", show_default=False)
    ] = None,
    json: Annotated[bool, flag("As JSON.")] = False,
) -> None:
    """Find servos on every USB serial port, at every baud rate, in every protocol. Up to 15 s per port.

    Finds Dynamixel servos of both protocols, and Feetech servos; prints a table of ID, model, firmware, voltage,
    temperature, torque and problems. With --robot, also reports servos that are missing, of another model, at another
    rate, duplicate, or not in robot.toml. Below are the cameras, by their names for robot.toml. Nothing is written to
    any servo, and torque stays as it is. Exit code 1 if there is a problem, or no servo answers.

    Needs: powered servos, and permission to open the port (`bodyschema doctor` checks it).

    Next: `bodyschema init --urdf YOUR.urdf --from scan`; `bodyschema doctor`.
    """
    from bodyschema.cli.hardware.scan_report import as_json, report_of, show
    from bodyschema.cli.terminal.screen import shown_on
    from bodyschema.daemon.wiring import servos as servo_wiring
    from bodyschema.daemon.wiring import wiring

    unknown = [rate for rate in baud if rate not in servo_wiring.scanned_bauds()]
    if unknown:
        known = ", ".join(map(str, servo_wiring.scanned_bauds()))
        raise ConfigError(f"--baud {unknown[0]} is no rate of such servos", remedy=f"Give one of {known}")
    config = None
    if robot is not None:
        from bodyschema.daemon.config import Config

        config = Config.load(robot)
        servo_wiring.require_servos(config)
    ports = servo_wiring.ports_to_scan(port, config)
    with shown_on(Console(stderr=True, highlight=False), "scan") as tell:
        report = replace(
            report_of(servo_wiring.scan(ports, baud, tell), config), cameras=tuple(wiring.connected_cameras())
        )
    if json:
        sys.stdout.write(as_json(report) + "\n")
    else:
        show(Console(highlight=False), report)
    if not report.is_well:
        sys.exit(1)
