"""`bodyschema robot`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import cyclopts
from cyclopts import Parameter

from bodyschema.cli.commands.options import HERE, flag, several

if TYPE_CHECKING:
    from bodyschema.cli.servos.fitting import Candidate, Fitting

robot = cyclopts.App(
    name="robot",
    help="""A robot.toml for the servos that you have.

    Needs: the URDF of your robot.

    Next: `bodyschema robot new --urdf my_robot.urdf --from scan`.
    """,
)

SCAN = "scan"


@robot.command(sort_key=1)
def new(
    *,
    urdf: Annotated[Path, Parameter(help="Your robot's URDF: joints and links are taken from it.")],
    source: Annotated[
        str, Parameter(name="--from", help="`scan` to look who is there, or a file that `scan --json` wrote.")
    ] = SCAN,
    port: Annotated[tuple[str, ...], several("Scan only this port")] = (),
    baud: Annotated[tuple[int, ...], several("Scan only at this rate")] = (),
    out: Annotated[Path, Parameter(name="--robot", help="The file to write.")] = HERE,
    yes: Annotated[bool, flag("Do not ask: the joints of the URDF get the servos in the order of their IDs.")] = False,
) -> None:
    """Write a commented robot.toml: joints from the URDF, and a servo for each. Never replaces a file.

    Asks which servo moves each joint; joints without a servo stay fixed. The result is checked against the URDF.
    Nothing is written to any servo.

    Needs: your robot's URDF, and powered servos (or a saved scan).

    Next: correct the entries marked CHECK; `bodyschema joints` for signs and zeros; `bodyschema config check`.
    """
    from bodyschema.cli.commands.config import say, write_new
    from bodyschema.cli.hardware.robot_template import guess_from, robot_toml
    from bodyschema.cli.servos.fitting import first_of, fit, servo_tables
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.wiring.wiring import connected_cameras
    from bodyschema.interfaces.errors import BodyschemaError, ConfigError

    guess = guess_from(urdf, out)
    if out.exists():
        raise ConfigError("is there already", file=out, remedy="Give another --robot, or move it away")
    fitting = fit(guess.joints, _candidates(source, port, baud), first_of if yes else _asked)
    text = robot_toml(guess._replace(joints=list(fitting.servos)), connected_cameras()) + servo_tables(fitting)
    try:
        write_new(out, text)
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=out, remedy="Give another --robot") from error
    try:
        Config.load(out)
    except BodyschemaError:
        out.unlink()
        raise
    for line in _told(fitting):
        say(line)
    say(f"{out} written. Next: `bodyschema joints --robot {out}`")


def _candidates(source: str, ports: Sequence[str], bauds: Sequence[int]) -> list[Candidate]:
    from rich.console import Console

    from bodyschema.cli.hardware.scan_report import as_json, report_of
    from bodyschema.cli.servos.fitting import candidates_in, read_scan
    from bodyschema.cli.terminal.progress import shown_on
    from bodyschema.daemon.wiring import servos as servo_wiring

    if source != SCAN:
        return read_scan(Path(source))
    found = servo_wiring.ports_to_scan(ports, None)
    with shown_on(Console(stderr=True, highlight=False), "scan") as tell:
        report = report_of(servo_wiring.scan(found, bauds, tell), None)
    return candidates_in(as_json(report).encode(), SCAN)


def _asked(joint: str, left: Sequence[Candidate]) -> Candidate | None:
    """Ask the user which servo moves `joint`; return it, or None."""
    from rich.prompt import Prompt

    if not left:
        return None
    names = {_name(servo, left): servo for servo in left}
    listed = ", ".join(f"{name} ({servo.model})" for name, servo in names.items())
    answer = Prompt.ask(
        f"Which ID moves [bold]{joint}[/bold]? {listed}, or - for none",
        choices=[*names, "-"],
        default=next(iter(names)),
        show_choices=False,
    )
    return names.get(answer)


def _name(servo: Candidate, left: Sequence[Candidate]) -> str:
    """Return its ID, with its port where the ID is not unique."""
    alone = sum(other.id == servo.id for other in left) == 1
    return str(servo.id) if alone else f"{servo.id}@{servo.port}"


def _told(fitting: Fitting) -> list[str]:
    lines = [f"  {joint}: ID {servo.id}, {servo.model}" for joint, servo in fitting.servos.items()]
    lines += [f"  {joint}: no servo, so it is not in joints and stands still at 0" for joint in fitting.bare]
    lines += [f"  ID {servo.id}, {servo.model}: moves none of the joints" for servo in fitting.left]
    return lines
