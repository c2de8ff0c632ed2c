"""`bodyschema servos`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import cyclopts
from cyclopts import Parameter
from cyclopts.validators import Number

from bodyschema.cli.commands.options import HERE, RobotFile, flag, several

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from bodyschema.cli.servos.changes import Planned
    from bodyschema.cli.servos.log import ServoLog
    from bodyschema.daemon.wiring.eeprom import Wanted, Workbench

servos = cyclopts.App(
    name="servos",
    help="""What servos keep without power: show it, and change it.

    The only commands that write to a servo's EEPROM. Each shows first what it would write, and asks; everything that
    was written is kept with the old value, and `bodyschema servos undo` takes the last of it back.

    Needs: robot.toml with servos, or --port and --id for one that is not in it; and no sampler that runs.

    Next: `bodyschema servos show`.
    """,
)

Joints = Annotated[tuple[str, ...], several("The servo of this joint")]
OneBus = Annotated[str | None, Parameter(help="All servos of this bus of robot.toml.", show_default=False)]
Port = Annotated[str | None, Parameter(help="With --id: a servo that robot.toml does not know.", show_default=False)]
Id = Annotated[
    int | None,
    Parameter(help="Its ID; 1 as it leaves the factory.", show_default=False, validator=Number(gte=0, lte=252)),
]
Baud = Annotated[int, Parameter(help="The rate at which it listens; Dynamixel servos leave the factory at 57600.")]
DryRun = Annotated[bool, flag("Show what would be written, and end.")]
Yes = Annotated[bool, flag("Do not ask.")]
RATE = 1_000_000


@servos.command(sort_key=1)
def show(
    *,
    joint: Joints = (),
    bus: OneBus = None,
    port: Port = None,
    id: Id = None,
    baud: Baud = RATE,
    robot: RobotFile = HERE,
) -> None:
    """Show the writable settings of the servos of robot.toml: names, present values, permitted values. Writes nothing.

    Needs: robot.toml with servos, or --port and --id; and no running sampler.

    Next: `bodyschema servos set`.
    """
    from rich.console import Console

    from bodyschema.cli.servos.changes_view import settings_table
    from bodyschema.daemon.wiring.eeprom import settings_by_name

    console = Console(highlight=False)
    wanted = _wanted(robot, joint, bus, port, id, baud)
    with _workbench(wanted) as workbench:
        for one in wanted:
            at = workbench.bus(one.port, one.baud)
            servo = workbench.fitted(at, one.entry, one.model)
            settings = settings_by_name(workbench, one.model).values()
            values = [(setting, workbench.value(at, servo, setting)) for setting in settings]
            console.print(settings_table(servo, values))


@servos.command(sort_key=2, name="set")
def set_(
    *settings: Annotated[str, Parameter(help="NAME=VALUE, as in return_delay=0, id=5, baud=2000000.")],
    joint: Joints = (),
    bus: OneBus = None,
    port: Port = None,
    id: Id = None,
    baud: Baud = RATE,
    dry_run: DryRun = False,
    yes: Yes = False,
    robot: RobotFile = HERE,
) -> None:
    """Write settings to servo EEPROM: shows them first, asks, switches torque off, writes, reads back.

    `bodyschema servos show` lists the names. `id` and `baud` are set alone. An ID that is taken is refused; after a
    change of rate each servo is searched at the new rate. Values are register values, except for the rate in bit/s and
    words (operating_mode=current). Torque is switched off: hold the arm, because it will sink. Exit code 1 if something
    was not written.

    Needs: robot.toml with servos, or --port and --id; and no running sampler.

    Next: the changes to robot.toml that it prints; `bodyschema servos undo` reverts the writes.
    """
    from bodyschema.cli.servos.changes import assignments, plan
    from bodyschema.interfaces.errors import ConfigError

    wishes = assignments(settings)
    if not wishes:
        raise ConfigError("nothing to set", remedy="Write NAME=VALUE; `bodyschema servos show` lists the names")
    if not (joint or bus or port):
        raise ConfigError(
            "it is not said which servos are meant", remedy="Name them with --joint, --bus, or --port and --id"
        )
    wanted = _wanted(robot, joint, bus, port, id, baud)
    with _workbench(wanted) as workbench:
        _carry_out(workbench, plan(workbench, wanted, wishes), _log(robot, port), dry_run=dry_run, yes=yes)


@servos.command(sort_key=3)
def zero(
    *,
    joint: Joints,
    in_servo: Annotated[bool, flag("Write the servo's homing offset instead.")] = False,
    dry_run: DryRun = False,
    yes: Yes = False,
    robot: RobotFile = HERE,
) -> None:
    """Set a joint's zero to its present position: prints zero_ticks for robot.toml, and writes nothing.

    With --in-servo, the servo's homing offset is written instead, so that its position here is robot.toml's zero_ticks.
    Either way, pairs measured before have another zero.

    Needs: robot.toml with servos, the joint held at its intended zero, and no running sampler.

    Next: put zero_ticks into robot.toml; `bodyschema joints` shows the angles.
    """
    from rich.console import Console

    from bodyschema.cli.servos.changes import plan_zeros, zero_ticks
    from bodyschema.cli.servos.changes_view import zero_lines

    wanted = _wanted(robot, joint, None, None, None, RATE)
    with _workbench(wanted) as workbench:
        if in_servo:
            _carry_out(workbench, plan_zeros(workbench, wanted), _log(robot, None), dry_run=dry_run, yes=yes)
            return
        console = Console(highlight=False, soft_wrap=True)
        for line in zero_lines(zero_ticks(workbench, wanted)):
            console.print(line, markup=False)
        console.print(f"Put it into the entry of the joint in {robot}. Nothing was written.", markup=False)


@servos.command(sort_key=4)
def undo(*, dry_run: DryRun = False, yes: Yes = False, port: Port = None, robot: RobotFile = HERE) -> None:
    """Undo what the last of these commands wrote. Settings that were changed otherwise since then are left alone.

    Needs: the same servos on the same ports; --port if they were selected that way.

    Next: `bodyschema servos show`.
    """
    from rich.console import Console

    from bodyschema.cli.servos.changes import plan_undo
    from bodyschema.daemon.wiring.eeprom import workbench_of
    from bodyschema.interfaces.errors import ConfigError

    log = _log(robot, port)
    entries = log.to_undo()
    if not entries:
        raise ConfigError(
            "there is nothing to take back", file=log.file, remedy="Nothing was written, or all is undone"
        )
    with workbench_of(entries[0].table) as workbench:
        planned, left = plan_undo(workbench, entries)
        console = Console(highlight=False, soft_wrap=True)
        for line in left:
            console.print(f"left alone: {line}", markup=False)
        _carry_out(workbench, planned, log, dry_run=dry_run, yes=yes, undoes=entries[0].batch)


def _wanted(
    robot: Path, joints: Sequence[str], bus: str | None, port: str | None, id: int | None, baud: int
) -> list[Wanted]:
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.wiring.eeprom import configured, stranger
    from bodyschema.interfaces.errors import ConfigError

    if (port is None) != (id is None):
        raise ConfigError("--port and --id belong together", remedy="Give both, or --joint for a servo of robot.toml")
    if port is None or id is None:
        return configured(Config.load(robot), joints, bus)
    if joints or bus:
        raise ConfigError("--port names a servo that robot.toml does not", remedy="Drop --joint and --bus")
    return [stranger(port, baud, id)]


def _workbench(wanted: Sequence[Wanted]) -> Workbench:
    from bodyschema.daemon.wiring.eeprom import workbench_of

    return workbench_of(wanted[0].table)


def _log(robot: Path, port: str | None) -> ServoLog:
    """Return the log next to the robot's pairs; for servos without a robot.toml, in a separate place."""
    from bodyschema.cli.servos.log import ServoLog
    from bodyschema.daemon.config import Config, state_home

    return ServoLog(state_home() if port is not None else Config.load(robot).state_dir)


def _carry_out(
    workbench: Workbench,
    planned: Sequence[Planned],
    log: ServoLog,
    *,
    dry_run: bool,
    yes: bool,
    undoes: int | None = None,
) -> None:
    from rich.console import Console

    from bodyschema.cli.servos.changes import carry_out, is_well
    from bodyschema.cli.servos.changes_view import done_table, planned_table
    from bodyschema.interfaces.clock import SystemClock

    console = Console(highlight=False)
    if planned:
        console.print(planned_table(planned))
    if not any(each.is_needed for each in planned):
        console.print("Nothing is to be written.")
        return
    if dry_run:
        console.print("Nothing was written, and torque is as it was.")
        return
    if not yes and not _agreed(console):
        console.print("Nothing was written, and torque is as it was.")
        return
    done = carry_out(workbench, planned, log, SystemClock(), undoes=undoes)
    console.print(done_table(done))
    console.print(f"Kept in {log.file}.", markup=False, soft_wrap=True)
    if not is_well(done):
        sys.exit(1)


def _agreed(console: Console) -> bool:
    from rich.prompt import Confirm

    asked = "Write it? Torque is switched off first: hold the arm"
    return Confirm.ask(asked, console=console, default=False)
