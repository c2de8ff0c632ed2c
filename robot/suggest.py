"""Suggest the nearest known name for a misspelt one."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Any, Literal, get_args, get_origin

import msgspec

_CHOICE = re.compile(r"Invalid enum value (?P<value>'[^']*'|\S+)(?: - at `\$(?P<path>[^`]*)`)?")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a remedy for an unknown name: the nearest known one, or the list of all."""
    names = list(known)
    close = get_close_matches(name, names, n=1)
    if close:
        return f"Did you mean {close[0]!r}?"
    return f"Known are: {', '.join(names) or 'none'}"


def first_few(names: Sequence[str], between: str = ", ") -> str:
    """Return the first three names, and the number of the others."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return between.join(names[:3]) + more


def with_choices(message: str, kind: Any) -> str:
    """Return msgspec's message about an unknown value, with the known values added."""
    wrong = _CHOICE.match(message)
    if wrong is None:
        return message
    keys = key_path(wrong["path"] or "")
    hint = hint_at(kind, keys)
    found = [hint, *get_args(hint)]
    choices = next(([str(value) for value in get_args(c)] for c in found if get_origin(c) is Literal), [])
    known = f", known are: {', '.join(choices)}" if choices else ""
    return f"{'.'.join(keys)}: {wrong['value']} is unknown{known}"


def key_path(path: str) -> tuple[str, ...]:
    """Return the keys in msgspec's path to a value, without list indices."""
    return tuple(part for part in re.sub(r"\[[^\]]*\]", "", path).split(".") if part)


def hint_at(kind: Any, keys: Sequence[str]) -> Any:
    """Return the type of the value under `keys` in the struct `kind`; None if there is no such field."""
    for key in keys:
        struct = struct_in(kind)
        fields = {} if struct is None else {field.encode_name: field.type for field in msgspec.structs.fields(struct)}
        kind = fields.get(key)
    return kind


def struct_in(hint: Any) -> type[msgspec.Struct] | None:
    """Return the struct that a type is or contains."""
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return hint
    return next((found for inner in get_args(hint) if (found := struct_in(inner)) is not None), None)
