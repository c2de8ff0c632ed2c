"""Set values in a TOML file that people have written, and leave the rest of its text as it is."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.whole_files import write_whole

from .toml_file import read_toml
from .toml_text import toml_value

_HEADING = re.compile(r"\s*\[")
BACKUP = ".before"


def with_values(file: Path, table: str, values: Mapping[str, Any]) -> str:
    """Return the text of a TOML file with values in a table, which has to be there; in the first of several.

    Raises:
        ConfigError: the file cannot be read, or has no such table of its own.
    """
    before, text = read_toml(file)
    lines = text.splitlines(keepends=True)
    heading = re.compile(rf"\s*\[{{1,2}}\s*{re.escape(table)}\s*\]{{1,2}}\s*(#.*)?$")
    start = next((k for k, line in enumerate(lines, 1) if heading.match(line)), None)
    if start is None:
        raise ConfigError(f"there is no table [{table}]", file=file, remedy="Write the two values where they belong")
    end = next((k for k in range(start, len(lines)) if _HEADING.match(lines[k])), len(lines))
    for key, value in values.items():
        entry = f"{key} = {toml_value(value)}"
        there = next((k for k in range(start, end) if re.match(rf"\s*{re.escape(key)}\s*=", lines[k])), None)
        if there is None:
            last = max((k for k in range(start, end) if lines[k].strip()), default=start - 1)
            lines[last] = lines[last].rstrip("\n") + "\n"
            lines.insert(last + 1, entry + "\n")
            end += 1
        else:
            comment = re.search(r"\s+#.*", lines[there])
            lines[there] = entry + (comment[0].rstrip("\n") if comment else "") + "\n"
    edited = "".join(lines)
    if _at(tomllib.loads(edited), table) != _at(before, table) | dict(values):
        raise ConfigError(f"[{table}] cannot be edited", file=file, remedy="Write the two values where they belong")
    return edited


def difference(file: Path, edited: str) -> list[str]:
    """Return the lines of a unified diff from a file to its edited text."""
    old = file.read_text(encoding="utf-8").splitlines()
    return list(difflib.unified_diff(old, edited.splitlines(), str(file), str(file), n=1, lineterm=""))


def write_edited(file: Path, edited: str) -> Path:
    """Replace a file by its edited text; return the name under which the old one is kept.

    Raises:
        ConfigError: nothing could be written.
    """
    backup = file.with_name(file.name + BACKUP)
    try:
        write_whole({backup: file.read_bytes(), file: edited.encode()})
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror}", file=file) from error
    return backup


def _at(tables: Mapping[str, Any], table: str) -> dict[str, Any]:
    found: Any = tables
    for part in table.split("."):
        found = found[part]
        if isinstance(found, list):
            found = found[0]
    return dict(found)
