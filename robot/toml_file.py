"""Read TOML files into typed structs, with errors that name the line to fix."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from bodyschema.interfaces.errors import ConfigError

from .limited import UnfitFile, read_at_most
from .suggest import did_you_mean, hint_at, key_path, struct_in, with_choices

T = TypeVar("T")

# Numbers with limits.
Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
Count = Annotated[int, msgspec.Meta(ge=1)]
# One chunk of a zenoh key: no separators, no wild cards, and not the @ that hides a chunk from wild cards.
NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.-]*\Z"  # `$` would let a line break follow

# Of a port, up to 65535.
_PORT = "([1-9][0-9]{0,3}|[1-5][0-9]{4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])"
# Of zenoh; sockets in the file system have no port.
ENDPOINT = re.compile(rf"(tcp|udp|tls|quic|ws)/.+:{_PORT}|unixsock-stream/.+")

_UNKNOWN = re.compile(r"Object contains unknown field `(?P<field>[^`]*)`(?: - at `\$(?P<path>[^`]*)`)?")
_HEADER = re.compile(r"\s*\[\[?([^\]]+)\]\]?")
_KEY = re.compile(r"\s*([A-Za-z0-9_.\"'-]+)\s*=")
# Strings and comments, up to the end of the text where one is not closed. Possessive, so that no text takes long.
_QUOTED = re.compile(
    r'''"""(?:[^"\\]++|\\.|"(?!""))*+(?:"{3,5}|\Z)|"(?:[^"\\\n]++|\\.)*+"?'''
    r"|'''(?:[^']++|'(?!''))*+(?:'{3,5}|\Z)|'[^'\n]*+'?|#[^\n]*+",
    re.DOTALL,
)
_BETWEEN = re.compile(r"[,=\[\]{}]")


class _Settings:
    # The largest robot.toml of ours has 8 KiB. One MiB of keys takes 0.5 GB of memory at most.
    max_bytes, max_parts = 2**20, 100


_PLACE = re.compile(r"(?P<what>.*?) - at `\$(?P<path>[^`]*)`$", re.DOTALL)


def read_toml(
    file: Path, *, written_by: str = "`bodyschema init` writes one", damaged: str = ""
) -> tuple[dict[str, Any], str]:
    """Return the tables of `file` and its text.

    Args:
        written_by: the command that writes such a file, as the remedy if it does not exist.
        damaged: the remedy for invalid text in a file not written by hand; by default that for a robot.toml.

    Raises:
        ConfigError: it cannot be read; the message has the line.
    """
    try:
        data = read_at_most(file, _Settings.max_bytes)
    except FileNotFoundError as error:
        raise ConfigError("there is no such file", file=file, remedy=written_by) from error
    except IsADirectoryError as error:
        raise ConfigError("a folder, not a file", file=file, remedy=damaged or "Name the robot.toml in it") from error
    except UnfitFile as error:
        raise ConfigError(str(error.strerror), file=file, remedy=damaged or "Name a robot.toml") from error
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=file, remedy="Fix its permissions") from error
    text = _decoded(data, file, damaged or "Name a robot.toml, or save it as UTF-8")
    if (line := line_of_endless_key(text)) is not None:
        raise ConfigError(f"a key has more than {_Settings.max_parts} parts", file=file, line=line, remedy="Delete it")
    try:
        return tomllib.loads(text), text
    except tomllib.TOMLDecodeError as error:
        line = re.search(r"line (\d+)", str(error))
        raise ConfigError(
            f"not TOML: {error}", file=file, line=int(line[1]) if line else None, remedy=damaged
        ) from error
    except RecursionError as error:
        raise ConfigError("not TOML: nested too deeply", file=file, remedy="Close the brackets") from error
    except ValueError as error:  # an integer of thousands of digits
        raise ConfigError(f"not TOML: {error}", file=file, remedy="Shorten the number") from error


def line_of_endless_key(text: str) -> int | None:
    """Return the first line (from 1) with a key of more than `most_parts` parts, which parse slowly; else None."""
    # Replace each string and comment by `q`; the number of lines stays the same.
    plain = _QUOTED.sub(lambda found: "q" + "\n" * found[0].count("\n"), text)
    for number, line in enumerate(plain.split("\n"), 1):
        most = _Settings.max_parts
        if line.count(".") > most and any(piece.count(".") > most for piece in _BETWEEN.split(line)):
            return number
    return None


def _unusable(value: object, keys: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the keys of values that are not allowed in any table, each with the reason."""
    if isinstance(value, float) and not math.isfinite(value):
        yield keys, "not a finite number"
    elif isinstance(value, str) and "\0" in value:
        yield keys, "has the character U+0000, which no name or path has"
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _unusable(inner, (*keys, key))
    elif isinstance(value, list):
        for inner in value:
            yield from _unusable(inner, keys)


def _decoded(data: bytes, file: Path, remedy: str) -> str:
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"the byte 0x{data[error.start]:02x} is not UTF-8 text",
            file=file,
            line=data.count(b"\n", 0, error.start) + 1,
            remedy=remedy,
        ) from error


def convert(tables: object, kind: type[T], *, file: Path, text: str, prefix: tuple[str, ...] = ()) -> T:
    """Convert `tables` to the struct `kind`.

    Args:
        prefix: the keys of `tables` in the file.

    Raises:
        ConfigError: a key is unknown, missing or wrong; the message has its line.
    """
    for keys, what in _unusable(tables, prefix):
        raise ConfigError(f"{'.'.join(keys)}: {what}", file=file, line=line_of(text, keys))
    try:
        return msgspec.convert(tables, kind)
    except msgspec.ValidationError as error:
        raise _located(str(error), kind, file, text, prefix) from error


def line_in_entry(text: str, name: str, place: int, key: str | None = None) -> int | None:
    """Return the line (from 1) of `key` in the entry `place` (from 0) of the array of tables [[name]].

    `name` may be dotted. If the entry has no such key, return the line of its heading; if the array is written in
    another way, return the line of the array.
    """
    lines, wanted = text.splitlines(), _dotted(name)
    entries = ((k, _HEADER.match(line)) for k, line in enumerate(lines) if line.lstrip().startswith("[["))
    headings = [k for k, header in entries if header and _dotted(header[1]) == wanted]
    if place >= len(headings):
        return line_of(text, (name,))
    first = headings[place]
    for number, line in enumerate(lines[first + 1 :], first + 2):
        if _HEADER.match(line):
            break
        if key is not None and (given := _KEY.match(line)) and _dotted(given[1]) == (key,):
            return number
    return first + 1


def line_of(text: str, keys: tuple[str, ...]) -> int | None:
    """Return the line (from 1) of the longest leading part of the key path `keys`; None if no line has any."""
    best: int | None = None
    longest = 0
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        header, key = _HEADER.match(line), _KEY.match(line)
        if header:
            table = given = _dotted(header[1])
        elif key:
            given = table + _dotted(key[1])
        else:
            continue
        if len(given) > longest and given == keys[: len(given)]:
            best, longest = number, len(given)
    return best


def _dotted(key: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in key.split("."))


def _located(message: str, kind: type, file: Path, text: str, prefix: tuple[str, ...]) -> ConfigError:
    unknown = _UNKNOWN.match(message)
    if unknown:
        keys = prefix + key_path(unknown["path"] or "")
        field = unknown["field"]
        where = ".".join(keys)
        return ConfigError(
            f"unknown key {field!r}{f' in [{where}]' if where else ''}",
            file=file,
            line=line_of(text, (*keys, field)),
            remedy=did_you_mean(field, _fields(kind, key_path(unknown["path"] or ""))),
        )
    place = _PLACE.match(message)
    keys = prefix + key_path(place["path"] if place else "")
    explained = with_choices(message, kind)
    if explained != message:
        return ConfigError(".".join((*prefix, explained)), file=file, line=line_of(text, keys))
    what = place["what"] if place else message
    named = f"{'.'.join(keys)}: " if keys else ""
    return ConfigError(f"{named}{what[:1].lower()}{what[1:]}", file=file, line=line_of(text, keys) if keys else None)


def _fields(kind: Any, keys: tuple[str, ...]) -> list[str]:
    struct = struct_in(hint_at(kind, keys))
    return [] if struct is None else [field.encode_name for field in msgspec.structs.fields(struct)]
