"""Plan, write, log and undo changes of servo EEPROM settings."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby

import msgspec
from rich.console import Group, RenderableType
from rich.text import Text

from bodyschema.cli.servos.log import LoggedWrite, ServoLog
from bodyschema.cli.terminal.screen import plain_table
from bodyschema.daemon.wiring.eeprom import (
    BAUD,
    HOMING_OFFSET,
    ID,
    Change,
    EepromEditor,
    IdentifiedServo,
    Outcome,
    SelectedServo,
    Setting,
    WriteResult,
    entry_of,
    model_called,
    setting_called,
    settings_by_name,
)
from bodyschema.interfaces.errors import BodyschemaError, ConfigError
from bodyschema.interfaces.protocols import Clock

ALONE = (ID, BAUD)  # these change the servo's address
POSITION_MODE, IGNORED_BEYOND = 3, 1024  # Dynamixel servos ignore a larger homing offset in this mode


@dataclass(frozen=True, slots=True)
class Planned:
    """A planned change, and the location of its servo."""

    selected: SelectedServo
    change: Change

    @property
    def is_needed(self) -> bool:
        return self.change.now != self.change.target


def assignments(texts: Sequence[str]) -> list[tuple[str, str]]:
    """Parse `NAME=VALUE` assignments; raise ConfigError if one is malformed."""
    found: list[tuple[str, str]] = []
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name or not value:
            raise ConfigError(f"{text!r} sets nothing", remedy="Write NAME=VALUE, as in return_delay=0")
        found.append((name.strip().lower(), value.strip()))
    names = [name for name, _ in found]
    if len(set(names)) < len(names):
        raise ConfigError("the same setting twice", remedy="Give each once")
    for name in ALONE:
        if name in names and len(names) > 1:
            raise ConfigError(f"{name} has to be set alone", remedy="Set the others first, in a command of their own")
    return found


def plan(editor: EepromEditor, selected: Sequence[SelectedServo], assigned: Sequence[tuple[str, str]]) -> list[Planned]:
    """Plan the writes. Queries the servos, and writes nothing.

    Raises:
        ConfigError: a model lacks a setting, a value is out of range, or an ID is taken.
        SourceError: a servo does not answer, or is another model.
    """
    if any(name == ID for name, _ in assigned) and len(selected) > 1:
        raise ConfigError("several servos cannot get one ID", remedy="Name one, with --joint or --id")
    planned: list[Planned] = []
    for one in selected:
        known = settings_by_name(editor, one.model)
        values = [(setting_called(name, known, one.model.name), text) for name, text in assigned]
        numbers = [(setting, setting.value(text)) for setting, text in values]
        bus = editor.bus(one.port, one.baud)
        servo = editor.identified_servo(bus, one.entry, one.model)
        for setting, target in numbers:
            change = Change(servo, setting, editor.value(bus, servo, setting), target)
            if setting.name == ID and target != change.now and editor.is_taken(bus, target):
                raise ConfigError(
                    f"the ID {target} is taken on {one.port}", remedy="`bodyschema scan` shows who is there"
                )
            planned.append(Planned(one, change))
    return planned


def plan_zeros(editor: EepromEditor, selected: Sequence[SelectedServo]) -> list[Planned]:
    """Plan homing offsets that set the joints to 0 at their present positions; writes nothing.

    Raises:
        ConfigError: a model has no homing offset, or would ignore it.
        SourceError: a servo does not answer, or is another model.
    """
    planned = []
    for one in selected:
        known = settings_by_name(editor, one.model)
        setting = setting_called(HOMING_OFFSET, known, one.model.name)
        bus = editor.bus(one.port, one.baud)
        servo = editor.identified_servo(bus, one.entry, one.model)
        target = editor.homing_offset(bus, servo)
        _require_effective(one, servo, setting, target)
        planned.append(Planned(one, Change(servo, setting, servo.homing_offset, target)))
    return planned


def _require_effective(selected: SelectedServo, servo: IdentifiedServo, setting: Setting, target: int) -> None:
    """Raise ConfigError if the servo would ignore such an offset, or cannot store it."""
    alternative = "`bodyschema servos --zero` without --in-servo prints zero_ticks for robot.toml, which serve as well"
    what = f"joint {servo.joint!r} would need the homing offset {setting.shown(target)}"
    if not setting.lowest <= target <= setting.highest:
        raise ConfigError(f"{what}, which is out of range", remedy=alternative)
    is_near = selected.table != "dynamixel" or selected.model.series == "P" or abs(target) <= IGNORED_BEYOND
    if not is_near and servo.operating_mode == POSITION_MODE:
        raise ConfigError(
            f"{what}, which it ignores in position mode", remedy=f"{alternative}. Or set operating_mode=extended"
        )


def zero_ticks(editor: EepromEditor, selected: Sequence[SelectedServo]) -> list[tuple[IdentifiedServo, int]]:
    """Return each servo's present position: the zero_ticks that put its joint at 0 there. Writes nothing."""
    found = []
    for one in selected:
        bus = editor.bus(one.port, one.baud)
        servo = editor.identified_servo(bus, one.entry, one.model)
        found.append((servo, editor.position(bus, servo)))
    return found


def carry_out(
    editor: EepromEditor, planned: Iterable[Planned], log: ServoLog, clock: Clock, *, undoes: int | None = None
) -> list[WriteResult]:
    """Switch torque off and verify it, then write the changes; log each write before sending it to the servo.

    Raises:
        SourceError: a servo's torque stays on, or it does not answer: nothing was written.
        ConfigError: the log cannot be written: nothing was written.
    """
    needed = [each for each in planned if each.is_needed]
    for each in needed:
        editor.torque_off(editor.bus(each.selected.port, each.selected.baud), [each.change.servo])
    batch = max(log.batches(), default=0) + 1
    entries = {id(each.change): _entry(each, batch, clock.utc(), undoes) for each in needed}
    done: list[WriteResult] = []
    for _, together in groupby(needed, key=lambda each: (each.selected.port, each.change.setting.name)):
        group = list(together)
        log.append([entries[id(each.change)] for each in group])
        results = _written(editor, group)
        log.append([msgspec.structs.replace(entries[id(one.change)], state=one.outcome.value) for one in results])
        done += results
    return done


def _written(editor: EepromEditor, group: Sequence[Planned]) -> list[WriteResult]:
    """Write all planned values of one setting on one port; with baud rates, write all before querying any servo."""
    first = group[0]
    if first.change.setting.name != BAUD:
        bus = editor.bus(first.selected.port, first.selected.baud)
        return [editor.write(bus, each.change) for each in group]
    done: list[WriteResult] = []
    for target in dict.fromkeys(each.change.target for each in group):
        changes = [each.change for each in group if each.change.target == target]
        rate = rate_of(first.change.setting, target)
        done += editor.write_bauds(first.selected.port, first.selected.baud, rate, changes)
    return done


def rate_of(setting: Setting, value: int) -> int:
    """Return the baud rate of a register's value [bit/s]."""
    return next(int(word) for word, known in setting.words.items() if known == value)


def plan_undo(editor: EepromEditor, entries: Sequence[LoggedWrite]) -> tuple[list[Planned], list[str]]:
    """Plan the writes that restore the old values; also return what is left unchanged, with reasons. Writes nothing."""
    planned, left = [], []
    for entry in reversed(entries):
        model = model_called(entry.table, entry.model)
        setting = setting_called(entry.name, settings_by_name(editor, model), model.name)
        place = msgspec.structs.replace(
            entry,
            id=entry.new if entry.name == ID else entry.id,
            baud=rate_of(setting, entry.new) if entry.name == BAUD else entry.baud,
        )
        try:
            selected = SelectedServo(entry.table, place.port, place.baud, entry_of(entry.joint, place.id, model), model)
            bus = editor.bus(selected.port, selected.baud)
            servo = editor.identified_servo(bus, selected.entry, model)
            now = editor.value(bus, servo, setting)
        except BodyschemaError as error:
            left.append(str(error))
            continue
        if now == entry.new:
            planned.append(Planned(selected, Change(servo, setting, now, entry.old)))
        else:
            left.append(f"{entry.joint} (ID {entry.id}): {entry.name} is {setting.shown(now)}, which we did not write")
    return planned, left


def is_well(done: Sequence[WriteResult]) -> bool:
    """Return True if everything was written without remarks."""
    return all(one.outcome is Outcome.WRITTEN and not one.remarks for one in done)


def _entry(planned: Planned, batch: int, utc: str, undoes: int | None) -> LoggedWrite:
    selected, change = planned.selected, planned.change
    return LoggedWrite(
        utc=utc,
        batch=batch,
        table=selected.table,
        port=selected.port,
        baud=selected.baud,
        id=change.servo.id,
        model=selected.model.name,
        joint=change.servo.joint,
        name=change.setting.name,
        address=change.setting.register.address,
        old=change.now,
        new=change.target,
        undoes=undoes,
    )


SCHEMA = 1  # of `settings_json`


def planned_table(planned: Sequence[Planned]) -> RenderableType:
    """Return a table of the writes: servo, register, present and new value; below it the consequences."""
    table = plain_table("joint", "ID", "register", "now", "", "then", right=("ID",))
    for each in planned:
        change = each.change
        arrow, style = ("→", "bold") if each.is_needed else ("=", "dim")
        target = Text(change.setting.shown(change.target), style=style)
        table.add_row(*_who(change), change.setting.shown(change.now), arrow, target)
    follows = {each.change.setting.name: each.change.setting.follows for each in planned if each.is_needed}
    lines = [Text(f"{name}: {what}", style="yellow") for name, what in follows.items() if what]
    return Group(table, *lines)


def done_table(done: Sequence[WriteResult]) -> RenderableType:
    """Return a table of the result of each write."""
    table = plain_table("joint", "ID", "register", "before", "", "now", right=("ID",))
    remarks: list[Text] = []
    for one in done:
        change, found = one.change, one.found
        is_written = one.outcome is Outcome.WRITTEN
        now = "?" if found is None else change.setting.shown(found)
        colour = "green" if is_written else "red"
        table.add_row(*_who(change), change.setting.shown(change.now), "→", Text(f"{now}  {one.outcome}", style=colour))
        if one.remarks:
            remarks.append(Text(f"{change.servo.joint} (ID {change.servo.id}): {one.remarks}", style="yellow"))
    return Group(table, *remarks)


def settings_table(servo: IdentifiedServo, values: Sequence[tuple[Setting, int]]) -> RenderableType:
    """Return a table of a servo's writable settings: names, present values, permitted values."""
    table = plain_table("register", "", "now", "may be", folded=("may be",))
    for setting, value in values:
        bounds = ", ".join(setting.words) or f"{setting.lowest} … {setting.highest}"
        table.add_row(setting.name, str(setting.register.address), setting.shown(value), bounds)
    head = f"{servo.joint}: ID {servo.id}, {servo.model.name}, firmware {servo.version}, on {servo.bus}"
    return Group(Text(head, style="bold"), table)


def settings_json(found: Sequence[tuple[IdentifiedServo, Sequence[tuple[Setting, int]]]]) -> str:
    """Return the servos' writable settings as JSON; values and bounds are those of the register."""
    servos = [
        {
            "joint": servo.joint,
            "id": servo.id,
            "model": servo.model.name,
            "bus": servo.bus,
            "settings": {
                setting.name: {"value": value, "lowest": setting.lowest, "highest": setting.highest}
                for setting, value in values
            },
        }
        for servo, values in found
    ]
    return json.dumps({"schema": SCHEMA, "servos": servos})


def zero_lines(found: Sequence[tuple[IdentifiedServo, int]]) -> list[str]:
    """Return the robot.toml lines that put each joint at 0 at its present position."""
    width = max(len(servo.joint) for servo, _ in found)
    return [f"{servo.joint:{width}}  zero_ticks = {ticks}    # {_moves(servo, ticks)}" for servo, ticks in found]


def _moves(servo: IdentifiedServo, ticks: int) -> str:
    if ticks == servo.zero_ticks:
        return "as it is"
    degrees = math.degrees(servo.angle(ticks))
    return f"now {servo.zero_ticks}: its angles become {abs(degrees):.1f}° {'less' if degrees > 0 else 'more'}"


def _who(change: Change) -> tuple[str, str, str]:
    setting = change.setting
    return change.servo.joint, str(change.servo.id), f"{setting.name} ({setting.register.address})"
