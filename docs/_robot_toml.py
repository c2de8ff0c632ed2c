"""Write reference/robot_toml.md from the classes that read robot.toml: `python docs/_robot_toml.py`."""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator
from pathlib import Path

import msgspec

from bodyschema.daemon.config import Tables
from bodyschema.robot.description import CameraSection, RobotSection

PAGE = Path(__file__).parent / "reference" / "robot_toml.md"
HEAD = """# robot.toml

Every table and key. `python docs/_robot_toml.py` writes this page from the source. Unknown keys are errors.
`bodyschema config --json` prints the values in force; an environment variable such as
`BODYSCHEMA_DAEMON_MAX_STEP_DEG=5` overrides one. `[[effects]]`, `[[background]]` and `[unexplained]` are written by
`diagnose` ([effects](../effects.md)).
"""
# These are plain dictionaries in `Tables`: the robot's description reads them.
SECTIONS = {"robot": RobotSection, "camera": CameraSection}
SEVERAL = (tuple, list)
Table = tuple[str, type[msgspec.Struct]]


def page() -> str:
    """Return the text of the page."""
    sections, first = [], dict[type[msgspec.Struct], str]()
    for heading, kind in _tables("", Tables):
        if kind in first:
            sections.append(f"\n`{heading}`: as `{first[kind]}`.\n")
        else:
            first[kind] = heading
            sections.append(_table(heading, kind))
    return HEAD + "".join(sections)


def _tables(prefix: str, kind: type[msgspec.Struct]) -> Iterator[Table]:
    """Yield the tables inside a table, in the order of the file, by their headings."""
    for name, annotation in typing.get_type_hints(kind, include_extras=True).items():
        if name.startswith("__"):
            continue
        inner = [SECTIONS[name]] if not prefix and name in SECTIONS else list(_structs(annotation))
        path = f"{prefix}{name}"
        several = any(typing.get_origin(part) in SEVERAL for part in _parts(annotation))
        for struct in inner:
            told = f" of kind {struct.__name__.removesuffix('Table').lower()}" if len(inner) > 1 else ""
            yield (f"[[{path}]]" if several else f"[{path}]") + told, struct
            yield from _tables(f"{path}.", struct)


def _parts(annotation: object) -> Iterator[object]:
    """Yield a type and all types that it is made of."""
    yield annotation
    for part in typing.get_args(annotation):
        yield from _parts(part)


def _structs(annotation: object) -> Iterator[type[msgspec.Struct]]:
    """Yield the tables that a value of this type may be."""
    for part in _parts(annotation):
        kind = typing.get_origin(part) or part
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            yield kind


def _table(heading: str, kind: type[msgspec.Struct]) -> str:
    """Return the section of one table; keys that are tables themselves have their own."""
    told = _documented(kind)
    fields = [field for field in msgspec.structs.fields(kind) if not list(_structs(field.type))]
    by_text: dict[str, list[msgspec.structs.FieldInfo]] = {}
    for field in fields:
        by_text.setdefault(told.get(field.name, ""), []).append(field)
    rows = []
    for text, keys in by_text.items():
        names = ", ".join(f"`{key.encode_name}`" for key in keys)
        rows.append(f"| {names} | {', '.join(dict.fromkeys(map(_default, keys)))} | {text} |")
    if not rows:
        return ""
    return f"\n## {heading}\n\n| key | default | meaning |\n| --- | --- | --- |\n" + "\n".join(rows) + "\n"


def _default(field: msgspec.structs.FieldInfo) -> str:
    if field.default is msgspec.NODEFAULT and field.default_factory is msgspec.NODEFAULT:
        return "required"
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    if value is None:
        return "–"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return f"`{value}`" if not isinstance(value, str) else f'`"{value}"`'


def _documented(kind: type[msgspec.Struct]) -> dict[str, str]:
    """Return what the docstrings of the class and its bases say of each key; keys that share a line share it here."""
    told: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        _, _, section = (base.__doc__ or "").partition("Attributes:\n")
        for entry in re.split(r"\n(?= {8}\w)", "\n" + section.split("\n\n")[0]):
            names, _, text = " ".join(entry.split()).partition(": ")
            told |= dict.fromkeys((name.strip() for name in names.split(",")), text.replace("|", "\\|"))
    return told


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
