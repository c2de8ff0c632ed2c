"""Tables as TOML text, for the files that the program writes itself. Comments are not its business."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(tables: Mapping[str, Any]) -> str:
    """The TOML text that reads as `tables`: of tables, lists, texts, numbers and truth values."""
    return "\n".join("\n".join(lines) + "\n" for lines in _tables((), tables))


def _tables(path: tuple[str, ...], table: Mapping[str, Any]) -> list[list[str]]:
    """One list of lines for each table: plain values first, since they belong to the last heading."""
    own = [f"[{'.'.join(map(_key, path))}]"] if path else []
    own += [f"{_key(name)} = {_value(value)}" for name, value in table.items() if not isinstance(value, Mapping)]
    inner = [
        lines for name, value in table.items() if isinstance(value, Mapping) for lines in _tables((*path, name), value)
    ]
    return [own, *inner] if own else inner


def _value(value: object) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            # Of JSON's escapes only that of a lone surrogate is none of TOML's, and a text from a file has none.
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case int() | float():
            return repr(value)
        case Mapping():
            return "{" + ", ".join(f"{_key(name)} = {_value(inner)}" for name, inner in value.items()) + "}"
        case list() | tuple():
            return "[" + ", ".join(map(_value, value)) + "]"
        case _:
            # Dates and times, which TOML writes as Python's ISO format does.
            return str(value)


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else _value(name)
