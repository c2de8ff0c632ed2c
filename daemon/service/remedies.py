"""Adapt commands in messages to the --robot option that the user gave."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Sequence

OPTION = "--robot"
# The other commands take no robot.toml, or write one.
_SINGLE = "backup, command, config, doctor, emulate, ik, predict, record, run, scan, servos, status, watch"
WITH_ROBOT = frozenset((*_SINGLE.split(", "), "calibrate latency"))
_QUOTED = re.compile(r"`bodyschema ([^`]+)`")
_LINE = re.compile(r"^bodyschema ([^#\n]+?)(?=\s*(?:#|$))")


def given_robot(arguments: Sequence[str]) -> str | None:
    """Return the --robot of a command line; None if it is omitted."""
    for place, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name == OPTION:
            return value if equals else next(iter(arguments[place + 1 :]), None)
    return None


def printable(text: str) -> str:
    """Return the text with its control characters escaped: a name in a file must not control the terminal."""
    return "".join(letter if letter.isprintable() or letter == "\n" else repr(letter)[1:-1] for letter in text)


def as_typed(text: str, arguments: Sequence[str] | None = None) -> str:
    """Return `text` with this command line's --robot added to each bodyschema command, in backticks or on its own line.

    Args:
        arguments: arguments of the command line; by default those of this process.
    """
    robot = given_robot(sys.argv[1:] if arguments is None else arguments)
    if robot is None:
        return text
    text = _QUOTED.sub(lambda found: f"`bodyschema {_for(robot, found[1])}`", text)
    return _LINE.sub(lambda found: f"bodyschema {_for(robot, found[1])}", text)


def _for(robot: str, command: str) -> str:
    words, file = command.split(" "), shlex.quote(robot)
    if OPTION in words:
        place = words.index(OPTION) + 1
        return " ".join([*words[:place], file, *words[place + 1 :]])
    if words[0] in WITH_ROBOT or " ".join(words[:2]) in WITH_ROBOT:
        return f"{command} {OPTION} {file}"
    return command
