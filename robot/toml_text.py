"""Write TOML: whole files, and values in a hand-written file, whose other text stays unchanged."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.whole_files import raising_write_errors, replace_with_backup

from .toml_file import read_toml

_BOM = "\ufeff"


def toml_text(tables: Mapping[str, Any]) -> str:
    """Return the TOML text of `tables`, which may contain tables, lists, strings, numbers and booleans."""
    return tomlkit.dumps(tables)


def toml_value(value: object) -> str:
    return tomlkit.item(value).as_string()


def with_values(file: Path, table: str, values: Mapping[str, Any]) -> str:
    """Return the text of a TOML file with values set in an existing table (the first one, if there are several).

    Each line keeps its line ending, and a new one takes that of the line before; a byte order mark stays.

    Raises:
        ConfigError: the file cannot be read, has no such table, or is written in a way that cannot be edited.
    """
    expected, _ = read_toml(file)
    text = file.read_bytes().decode()
    listed = ", ".join(f"{key} = {toml_value(value)}" for key, value in values.items())
    by_hand = f"Nothing was changed. Write into [{table}] yourself: {listed}"
    try:
        document = tomlkit.parse(text.removeprefix(_BOM).replace("\r\n", "\n"))
        for tables in (document, expected):
            found: Any = tables
            for part in table.split("."):
                found = found.get(part)
                found = found[0] if isinstance(found, list) and found else found
                if not isinstance(found, Mapping):
                    raise ConfigError(f"there is no table [{table}]", file=file, remedy=by_hand)
            found.update(values)  # pyright: ignore[reportAttributeAccessIssue]
        edited = tomlkit.dumps(document)
        if tomllib.loads(edited) != expected:
            raise ConfigError(f"[{table}] is written so that it cannot be edited", file=file, remedy=by_hand)
    except (TOMLKitError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(
            f"[{table}] is written so that it cannot be edited: {str(error).rstrip('.')}", file=file, remedy=by_hand
        ) from error
    return _BOM * text.startswith(_BOM) + _with_line_ends(edited, text.removeprefix(_BOM))


def _with_line_ends(edited: str, text: str) -> str:
    """Return an edited text, whose lines end in LF, with the line endings of the original text."""
    ends = ["\r" * line.endswith("\r") for line in text.split("\n")]
    ends[-1] = ends[max(len(ends) - 2, 0)]  # the last line has no ending: lines after it take that of the line before
    old, new = text.replace("\r\n", "\n").split("\n"), edited.split("\n")
    for _, first, last, begin, end in difflib.SequenceMatcher(None, old, new).get_opcodes():
        for k in range(begin, min(end, len(new) - 1)):
            new[k] += ends[max(min(first + k - begin, last - 1), 0)]
    return "\n".join(new)


def difference(file: Path, edited: str) -> list[str]:
    """Return the lines of a unified diff from a file to its edited text."""
    old, new = file.read_text(encoding="utf-8-sig").splitlines(), edited.removeprefix(_BOM).splitlines()
    return list(difflib.unified_diff(old, new, str(file), str(file), n=1, lineterm=""))


def write_edited(file: Path, edited: str) -> Path:
    """Replace a file by its edited text; return the name under which the old one is kept.

    Raises:
        ConfigError: nothing could be written.
    """
    with raising_write_errors(file):
        return replace_with_backup(file, edited.encode())
