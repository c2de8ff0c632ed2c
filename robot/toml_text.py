"""Write tables as TOML text, for files that the program writes itself, without comments."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(tables: Mapping[str, Any]) -> str:
    """Return the TOML text of `tables`, which may contain tables, lists, strings, numbers and booleans."""
    return "\n".join("\n".join(lines) + "\n" for lines in _tables((), tables))


def _tables(path: tuple[str, ...], table: Mapping[str, Any]) -> list[list[str]]:
    """Return one list of lines for each table, beginning with its heading."""
    heading = [f"[{_dotted(path)}]"] if path else []
    own, inner = _parts(path, table)
    return [heading + own, *inner] if heading or own else inner


def _parts(path: tuple[str, ...], table: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return the lines of a table's plain values, which must follow its heading, and the lines of its inner tables."""
    own: list[str] = []
    inner: list[list[str]] = []
    for name, value in table.items():
        below = (*path, name)
        if isinstance(value, Mapping):
            inner += _tables(below, value)
        elif isinstance(value, list | tuple) and value and all(isinstance(entry, Mapping) for entry in value):
            for entry in value:
                plain, tables = _parts(below, entry)
                inner += [[f"[[{_dotted(below)}]]", *plain], *tables]
        else:
            own.append(f"{_key(name)} = {toml_value(value)}")
    return own, inner


def _dotted(path: tuple[str, ...]) -> str:
    return ".".join(map(_key, path))


def toml_value(value: object) -> str:
    """Return a value as TOML, in one line."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            # The only JSON escape that TOML lacks is that of a lone surrogate, which no file's text contains.
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case int() | float():
            return repr(value)
        case Mapping():
            return "{" + ", ".join(f"{_key(name)} = {toml_value(inner)}" for name, inner in value.items()) + "}"
        case list() | tuple():
            return "[" + ", ".join(map(toml_value, value)) + "]"
        case _:
            # Dates and times: TOML uses Python's ISO format.
            return str(value)


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else toml_value(name)
