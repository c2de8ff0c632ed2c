"""Set values in a TOML file that people have written, and leave the rest of its text as it is."""

from __future__ import annotations

import copy
import difflib
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.whole_files import replace_kept

from .toml_file import read_toml, without_quoted
from .toml_text import toml_value

_BOM = "\ufeff"
_BRACKETS = re.compile(r"[\[\]{}]")


def with_values(file: Path, table: str, values: Mapping[str, Any]) -> str:
    """Return the text of a TOML file with values in a table, which has to be there; in the first of several.

    Line ends and a byte order mark are those of the file.

    Raises:
        ConfigError: the file cannot be read, or has no such table of its own, or is written in a way that cannot be
            edited.
    """
    before, _ = read_toml(file)
    text = file.read_bytes().decode()
    lines = text.removeprefix(_BOM).split("\n")
    outside = _outside_values(lines)
    headings = [k for k, line in enumerate(outside) if line.lstrip().startswith("[")]
    name = r"\s*\.\s*".join(map(_key, table.split(".")))
    heading = re.compile(rf"\s*\[{{1,2}}\s*{name}\s*\]{{1,2}}\s*(#.*)?$")
    expected = copy.deepcopy(before)
    start = next((k + 1 for k in headings if heading.match(lines[k])), None)
    if start is None or (edited_table := _at(expected, table)) is None:
        raise ConfigError(f"there is no table [{table}]", file=file, remedy=_by_hand(table, values))
    edited_table |= values
    end = next((k for k in headings if k >= start), len(lines))
    own = [k for k in range(start, end) if "=" in outside[k]]
    last = max((k for k in range(start, end) if lines[k].strip()), default=start - 1)
    line_end = "\r" if "\r\n" in text else ""
    added: list[str] = []
    for key, value in values.items():
        entry = f"{key} = {toml_value(value)}"
        there = next((k for k in own if re.match(rf"\s*{_key(key)}\s*=", lines[k])), None)
        if there is None:
            added.append(entry + line_end)
        else:
            indent, comment = re.match(r"\s*", lines[there]), re.search(r"\s*(#.*)?$", lines[there])
            lines[there] = (indent[0] if indent else "") + entry + (comment[0] if comment else "")
    if added and last == len(lines) - 1:  # the file ends without a line end
        lines[last] += line_end
        added.append("")
    lines[last + 1 : last + 1] = added
    edited = "\n".join(lines)
    if not _reads_as(edited, expected):
        raise ConfigError(
            f"[{table}] is written so that it cannot be edited", file=file, remedy=_by_hand(table, values)
        )
    return _BOM * text.startswith(_BOM) + edited


def difference(file: Path, edited: str) -> list[str]:
    """Return the lines of a unified diff from a file to its edited text."""
    old, new = file.read_text(encoding="utf-8-sig").splitlines(), edited.removeprefix(_BOM).splitlines()
    return list(difflib.unified_diff(old, new, str(file), str(file), n=1, lineterm=""))


def write_edited(file: Path, edited: str) -> Path:
    """Replace a file by its edited text; return the name under which the old one is kept.

    Raises:
        ConfigError: nothing could be written.
    """
    try:
        return replace_kept(file, edited.encode())
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=file) from error


def _key(name: str) -> str:
    """Return a pattern of a key, bare or quoted."""
    return rf"(?:{re.escape(name)}|\"{re.escape(name)}\"|'{re.escape(name)}')"


def _outside_values(lines: list[str]) -> list[str]:
    """Return the lines without strings and comments; those that begin inside a value are empty."""
    outside, depth = list[str](), 0
    for line in without_quoted("\n".join(lines)).split("\n"):
        outside.append("" if depth else line)
        depth += sum(1 if bracket in "[{" else -1 for bracket in _BRACKETS.findall(line))
    return outside


def _at(tables: Mapping[str, Any], table: str) -> dict[str, Any] | None:
    found: Any = tables
    for part in table.split("."):
        found = found.get(part)
        if isinstance(found, list) and found:
            found = found[0]
        if not isinstance(found, dict):
            return None
    return found


def _reads_as(text: str, expected: Mapping[str, Any]) -> bool:
    try:
        return tomllib.loads(text) == expected
    except tomllib.TOMLDecodeError:
        return False


def _by_hand(table: str, values: Mapping[str, Any]) -> str:
    listed = ", ".join(f"{key} = {toml_value(value)}" for key, value in values.items())
    return f"Nothing was changed. Write into [{table}] yourself: {listed}"
