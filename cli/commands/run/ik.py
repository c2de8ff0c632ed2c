"""`bodyschema ik`."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bodyschema.cli.commands.options import HERE, RobotFile, flag, print_json
from bodyschema.interfaces.errors import RequestError

if TYPE_CHECKING:
    from bodyschema.daemon.client_config import ClientConfig
    from bodyschema.daemon.transport.wire import IkReply

REASONS = {
    "reached": "reached",
    "out_of_reach": "out of reach: the nearest position found is {mm:.1f} mm away",
    "steps_ran_out": "not reached within the solver's steps: {mm:.1f} mm are missing",
}


def ik(
    x: Annotated[float, Parameter(help="Where the marker is wanted, in the measurement frame [m].")],
    y: Annotated[float, Parameter(help="The same, y [m].")],
    z: Annotated[float, Parameter(help="The same, z [m].")],
    /,
    *,
    posture: Annotated[
        Literal["middle"] | None, Parameter(help="As far as there is a choice, stay in the middle of the joint limits.")
    ] = None,
    robot: RobotFile = HERE,
    deg: Annotated[bool, flag("Angles are in degrees.")] = False,
    as_json: Annotated[bool, flag("Print the learner's reply, with the pose in SI, as JSON.", name="--json")] = False,
) -> None:
    """Ask the learner for joint angles that bring the marker to a position in the measurement frame.

    The angles are within the URDF's limits. If the position cannot be reached, shows the closest solution and ends with
    exit code 1. Nothing moves. For example: `bodyschema ik -0.1 0.2 0.7`.

    Needs: a running learner (`bodyschema run` or `bodyschema run learner`).

    Next: the same from your own program, starting at your arm's current angles: docs/zenoh.md.
    """
    from bodyschema.daemon.client_config import ClientConfig
    from bodyschema.daemon.transport.keys import Keys
    from bodyschema.daemon.transport.session import client
    from bodyschema.daemon.transport.wire import IkReply, IkRequest, decode, encode

    config = ClientConfig.load(robot)
    if not all(map(math.isfinite, (x, y, z))):
        raise RequestError(f"{x:g}, {y:g}, {z:g} is no position: give three finite numbers in metres")
    with config.checked_on_error(), client(config.route("learner")) as bus:
        reply = decode(bus.ask_one(Keys(config.name).ik, encode(IkRequest((x, y, z), posture=posture))), IkReply)
    if as_json:
        print_json(reply)
    else:
        _show(reply, config, deg)
    if not reply.converged:
        sys.exit(1)


def _show(reply: IkReply, config: ClientConfig, deg: bool) -> None:
    from bodyschema.cli.terminal.screen import two_digits

    table = Table(box=None, pad_edge=False, header_style="bold", show_header=False)
    for name, value, slides in zip(config.joints, reply.q, config.slides, strict=True):
        unit = "m" if slides else "deg" if deg else "rad"
        digits = 2 if unit == "deg" else 4
        shown = round(math.degrees(value) if unit == "deg" else value, digits) + 0.0  # no -0.00
        table.add_row(Text(name), f"{shown:.{digits}f}", unit)
    console = Console(highlight=False)
    console.print(table)
    console.print(REASONS[reply.reason].format(mm=1e3 * reply.distance))
    spread = ", ".join(two_digits(1e3 * value) for value in reply.sigma)
    where = "where data was" if reply.in_support else "away from all data"
    console.print(
        f"1-sigma of x, y, z there {spread} mm, {where}; model {reply.model}, {reply.pairs} samples", style="dim"
    )
