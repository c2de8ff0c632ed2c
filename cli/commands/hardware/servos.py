"""`bodyschema servos`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console
from rich.prompt import Confirm

from bodyschema.cli.commands.options import HERE, RobotFile, flag, say, several
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError, RequestError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bodyschema.cli.servos.changes import Planned
    from bodyschema.cli.servos.log import ServoLog
    from bodyschema.daemon.wiring.eeprom import EepromEditor, SelectedServo

RATE = 1_000_000


def servos(
    *settings: Annotated[str, Parameter(help="NAME=VALUE to write, as in return_delay=0, id=5, baud=2000000.")],
    zero: Annotated[bool, flag("Set the zero of --joint to its present position: prints zero_ticks.")] = False,
    in_servo: Annotated[bool, flag("With --zero: write the servo's homing offset instead.")] = False,
    undo: Annotated[bool, flag("Undo what the last of these commands wrote.")] = False,
    joint: Annotated[tuple[str, ...], several("The servo of this joint")] = (),
    bus: Annotated[str | None, Parameter(help="All servos of this bus of robot.toml.", show_default=False)] = None,
    port: Annotated[
        str | None, Parameter(help="With --id: a servo that robot.toml does not know.", show_default=False)
    ] = None,
    id: Annotated[
        int | None,
        Parameter(help="Its ID; 1 as it leaves the factory.", show_default=False, validator=Number(gte=0, lte=252)),
    ] = None,
    baud: Annotated[
        int, Parameter(help="The rate at which it listens; Dynamixel servos leave the factory at 57600.")
    ] = RATE,
    dry_run: Annotated[bool, flag("Show what would be written, and end.")] = False,
    yes: Annotated[bool, flag("Do not ask.")] = False,
    as_json: Annotated[bool, flag("Print the settings as JSON.", name="--json")] = False,
    robot: RobotFile = HERE,
) -> None:
    """Show the settings that servos keep without power; with NAME=VALUE, write them to the EEPROM.

    Without NAME=VALUE nothing is written: names, present values and permitted values are listed. A write is shown first
    and has to be confirmed; then torque is switched off (hold the arm, because it will sink), and every value is read
    back. Each written value is logged with the old one, and --undo writes the old one back; settings that were changed
    otherwise since then are left alone.

    `id` and `baud` can only be set alone. An ID that is taken is refused; after a change of rate each servo is searched
    for at the new rate. Values are register values, except for the rate in bit/s and words (operating_mode=current).

    --zero prints the joint's present position as zero_ticks for robot.toml, and writes nothing. With --in-servo, the
    servo's homing offset is written instead, so that its present position becomes robot.toml's zero_ticks. Either way,
    earlier samples have another zero. Exit code 1 if something was not written.

    Needs: robot.toml with servos, or --port and --id; and no running sampler.

    Next: the changes to robot.toml that it prints; `bodyschema watch joints` shows the angles.
    """
    from bodyschema.cli.servos.changes import assignments, plan

    if bool(settings) + zero + undo > 1:
        raise RequestError("give NAME=VALUE, --zero or --undo, one of them")
    if in_servo and not zero:
        raise RequestError("--in-servo goes with --zero")
    if undo:
        _undo(robot, port, dry_run=dry_run, yes=yes)
        return
    if zero:
        _zero(robot, joint, in_servo=in_servo, dry_run=dry_run, yes=yes)
        return
    assigned = assignments(settings)
    if assigned and not (joint or bus or port):
        raise ConfigError("no servos are named", remedy="Name them with --joint, --bus, or --port and --id")
    selected = _selected_servos(robot, joint, bus, port, id, baud)
    if assigned:
        log = _log(robot, port)
        with _editor(selected) as editor:
            _carry_out(editor, plan(editor, selected, assigned), log, dry_run=dry_run, yes=yes)
    else:
        _show(selected, as_json=as_json)


def _show(selected: Sequence[SelectedServo], *, as_json: bool) -> None:
    from bodyschema.cli.servos.changes import settings_json, settings_table
    from bodyschema.daemon.wiring.eeprom import settings_by_name

    found = []
    with _editor(selected) as editor:
        for one in selected:
            at = editor.bus(one.port, one.baud)
            servo = editor.identified_servo(at, one.entry, one.model)
            settings = settings_by_name(editor, one.model).values()
            found.append((servo, [(setting, editor.value(at, servo, setting)) for setting in settings]))
            if not as_json:
                Console(highlight=False).print(settings_table(*found[-1]))
    if as_json:
        sys.stdout.write(settings_json(found) + "\n")


def _zero(robot: Path, joint: tuple[str, ...], *, in_servo: bool, dry_run: bool, yes: bool) -> None:
    from bodyschema.cli.servos.changes import plan_zeros, zero_lines, zero_ticks

    if not joint:
        raise ConfigError("no joint is named", remedy="Name it with --joint")
    selected = _selected_servos(robot, joint, None, None, None, RATE)
    with _editor(selected) as editor:
        if in_servo:
            _carry_out(editor, plan_zeros(editor, selected), _log(robot, None), dry_run=dry_run, yes=yes)
            return
        say(*zero_lines(zero_ticks(editor, selected)))
        say(f"Put it into the entry of the joint in {robot}. Nothing was written.")


def _undo(robot: Path, port: str | None, *, dry_run: bool, yes: bool) -> None:
    from bodyschema.cli.servos.changes import plan_undo
    from bodyschema.daemon.wiring.eeprom import editor_of

    log = _log(robot, port)
    entries = log.to_undo()
    if not entries:
        raise ConfigError(
            "there is nothing to take back", file=log.file, remedy="Nothing was written, or all is undone"
        )
    with editor_of(entries[0].table) as editor:
        planned, left = plan_undo(editor, entries)
        say(*(f"left alone: {line}" for line in left))
        _carry_out(editor, planned, log, dry_run=dry_run, yes=yes, undoes=entries[0].batch)


def _selected_servos(
    robot: Path, joints: Sequence[str], bus: str | None, port: str | None, id: int | None, baud: int
) -> list[SelectedServo]:
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.wiring.eeprom import configured, stranger

    if (port is None) != (id is None):
        raise ConfigError("--port and --id belong together", remedy="Give both, or --joint for a servo of robot.toml")
    if port is None or id is None:
        return configured(Config.load(robot), joints, bus)
    if joints or bus:
        raise ConfigError("--port names a servo that robot.toml does not", remedy="Drop --joint and --bus")
    return [stranger(port, baud, id)]


def _editor(selected: Sequence[SelectedServo]) -> EepromEditor:
    from bodyschema.daemon.wiring.eeprom import editor_of

    return editor_of(selected[0].table)


def _log(robot: Path, port: str | None) -> ServoLog:
    """Return the log next to the robot's pairs; for servos without a robot.toml, in a separate place."""
    from bodyschema.cli.servos.log import ServoLog
    from bodyschema.daemon.config import Config, state_home

    return ServoLog(state_home() if port is not None else Config.load(robot).state_dir)


def _carry_out(
    editor: EepromEditor,
    planned: Sequence[Planned],
    log: ServoLog,
    *,
    dry_run: bool,
    yes: bool,
    undoes: int | None = None,
) -> None:
    from bodyschema.cli.servos.changes import carry_out, done_table, is_well, planned_table

    console = Console(highlight=False)
    if planned:
        console.print(planned_table(planned))
    if not any(each.is_needed for each in planned):
        say("Nothing is to be written.")
        return
    question = "Write it? Torque is switched off first: hold the arm"
    if dry_run or not (yes or Confirm.ask(question, console=console, default=False)):
        say("Nothing was written, and torque is as it was.")
        return
    done = carry_out(editor, planned, log, SystemClock(), undoes=undoes)
    console.print(done_table(done))
    say(f"Kept in {log.file}.")
    if not is_well(done):
        sys.exit(1)
