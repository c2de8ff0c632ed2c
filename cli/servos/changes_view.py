"""Tables of servo EEPROM contents, planned writes and results."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from bodyschema.daemon.wiring.eeprom import Change, Done, IdentifiedServo, Outcome, Setting

from .changes import Planned

SCHEMA = 1  # of `settings_json`


def planned_table(planned: Sequence[Planned]) -> RenderableType:
    """Return a table of the writes: servo, register, present and new value; below it the consequences."""
    table = _table("joint", "ID", "register", "now", "", "then")
    for each in planned:
        change = each.change
        arrow, style = ("→", "bold") if each.is_needed else ("=", "dim")
        table.add_row(*_who(change), change.setting.shown(change.now), arrow, Text(_then(change), style=style))
    follows = {each.change.setting.name: each.change.setting.follows for each in planned if each.is_needed}
    lines = [Text(f"{name}: {what}", style="yellow") for name, what in follows.items() if what]
    return Group(table, *lines)


def done_table(done: Sequence[Done]) -> RenderableType:
    """Return a table of the result of each write."""
    table = _table("joint", "ID", "register", "before", "", "now")
    said: list[Text] = []
    for one in done:
        change, found = one.change, one.found
        is_written = one.outcome is Outcome.WRITTEN
        now = "?" if found is None else change.setting.shown(found)
        colour = "green" if is_written else "red"
        table.add_row(*_who(change), change.setting.shown(change.now), "→", Text(f"{now}  {one.outcome}", style=colour))
        if one.said:
            said.append(Text(f"{change.servo.joint} (ID {change.servo.id}): {one.said}", style="yellow"))
    return Group(table, *said)


def settings_table(servo: IdentifiedServo, values: Sequence[tuple[Setting, int]]) -> RenderableType:
    """Return a table of a servo's writable settings: names, present values, permitted values."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for heading in ("register", "", "now", "may be"):
        table.add_column(heading, no_wrap=heading != "may be")
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


def _table(*headings: str) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for heading in headings:
        table.add_column(heading, justify="right" if heading == "ID" else "left", no_wrap=True)
    return table


def _who(change: Change) -> tuple[str, str, str]:
    setting = change.setting
    return change.servo.joint, str(change.servo.id), f"{setting.name} ({setting.register.address})"


def _then(change: Change) -> str:
    return change.setting.shown(change.then)
