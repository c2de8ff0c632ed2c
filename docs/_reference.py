"""Write the pages of reference/ from the classes that they describe: `python docs/_reference.py`."""

from __future__ import annotations

import ast
import inspect
import io
import re
import textwrap
import tokenize
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from tokenize import COMMENT

import msgspec

from bodyschema.daemon.config import Tables
from bodyschema.daemon.sampler import sources
from bodyschema.daemon.transport import status, wire
from bodyschema.robot.description import CameraSection, RobotSection

FOLDER = Path(__file__).parent / "reference"
TOML_HEAD = """# robot.toml

Every table and key. `python docs/_reference.py` writes this page from the source. Unknown keys are errors.
`bodyschema config --json` prints the values in force; an environment variable such as
`BODYSCHEMA_DAEMON_MAX_STEP_DEG=5` overrides one. `[[effects]]`, `[[background]]` and `[unexplained]` are written by
`diagnose` ([effects](../effects.md)).
"""
MESSAGES_HEAD = """# Messages

Every message over zenoh, by its name. `python docs/_reference.py` writes this page from the source.
[Talking over zenoh](../zenoh.md) has keys, encodings, frames and examples. d is the number of joints, n that of the
request's rows.
"""
# These are plain dictionaries in `Tables`: the robot's description reads them.
SECTIONS = {"robot": RobotSection, "camera": CameraSection}
SEVERAL = (tuple, list)
Table = tuple[str, type[msgspec.Struct]]


def robot_toml() -> str:
    """Return the text of the page on robot.toml."""
    sections, first = [], dict[type[msgspec.Struct], str]()
    for heading, kind in _tables("", Tables):
        if kind in first:
            sections.append(f"\n`{heading}`: as `{first[kind]}`.\n")
        else:
            sections.append(_table(heading, kind, first))
            first |= dict.fromkeys((base for base in kind.__mro__ if base not in first), heading)
    return TOML_HEAD + "".join(sections)


def _tables(prefix: str, kind: type[msgspec.Struct]) -> Iterator[Table]:
    """Yield the tables inside a table, in the order of the file, by their headings."""
    for name, annotation in typing.get_type_hints(kind, include_extras=True).items():
        if name.startswith("__"):
            continue
        inner = [SECTIONS[name]] if not prefix and name in SECTIONS else list(_structs(_bound(annotation, kind)))
        path = f"{prefix}{name}"
        if inner and any(typing.get_origin(part) is dict for part in _parts(annotation)) and name not in SECTIONS:
            path += ".NAME"
        several = any(typing.get_origin(part) in SEVERAL for part in _parts(annotation))
        for struct in inner:
            told = f" of kind {struct.__name__.removesuffix('Table').lower()}" if len(inner) > 1 else ""
            yield (f"[[{path}]]" if several else f"[{path}]") + told, struct
            yield from _tables(f"{path}.", struct)


def _bound(annotation: object, kind: type[msgspec.Struct]) -> object:
    """Return the type that a dictionary of a generic table has in this one; any other as it is."""
    last = (typing.get_args(annotation) or (None,))[-1]
    if not isinstance(last, typing.TypeVar):
        return annotation
    [generic] = (base for base in kind.__orig_bases__ if typing.get_args(base))  # pyright: ignore[reportAttributeAccessIssue]
    return typing.get_args(generic)[0]


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


def _table(heading: str, kind: type[msgspec.Struct], first: dict[type[msgspec.Struct], str]) -> str:
    """Return the section of one table; keys that can only be tables have their own.

    Args:
        first: the table that describes the keys of a class, of those before this one.
    """
    told = _documented(kind)
    fields = [field for field in msgspec.structs.fields(kind) if not list(_structs(field.type)) or _is_word(field.type)]
    by_text: dict[str, list[msgspec.structs.FieldInfo]] = {}
    described: dict[str, list[str]] = {}
    for field in fields:
        where = first.get(_definer(kind, field.name))
        if where is None:
            by_text.setdefault(told.get(field.name, ""), []).append(field)
        else:
            described.setdefault(where, []).append(f"`{field.encode_name}`")
    shared = "".join(f"\nAs in `{where}`: {', '.join(names)}.\n" for where, names in described.items())
    rows = []
    for text, keys in by_text.items():
        names = ", ".join(f"`{key.encode_name}`" for key in keys)
        rows.append(f"| {names} | {', '.join(dict.fromkeys(map(_default, keys)))} | {text} |")
    if not rows:
        return f"\n## {heading}\n{shared}" if shared else ""
    table = "| key | default | meaning |\n| --- | --- | --- |\n" + "\n".join(rows) + "\n"
    return f"\n## {heading}\n{shared}\n{table}"


def _is_word(annotation: object) -> bool:
    """Return True for a key that is a table or one of some words."""
    return any(typing.get_origin(part) is typing.Literal for part in typing.get_args(annotation))


def _definer(kind: type[msgspec.Struct], name: str) -> type[msgspec.Struct]:
    """Return the class, of a table and its bases, that says what a key is."""
    return next(base for base in kind.__mro__ if name in inspect.get_annotations(base))


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
    """Return what the class and its bases say of each key: in `Attributes:`, or beside and above the fields."""
    told: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        _, _, section = (base.__doc__ or "").partition("Attributes:\n")
        for entry in re.split(r"\n(?= {8}\w)", "\n" + section.split("\n\n")[0]):
            names, _, text = " ".join(entry.split()).partition(": ")
            told |= dict.fromkeys((name.strip() for name in names.split(",")), text)
        if issubclass(base, msgspec.Struct) and base is not msgspec.Struct:
            told |= _beside(textwrap.dedent(inspect.getsource(base)))
    return {name: text.replace("|", "\\|") for name, text in told.items()}


def _beside(source: str) -> dict[str, str]:
    """Return what the comments of a class say of each field; those above may begin with the names that share them."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {token.start[0]: (token.string[1:].strip(), token.line) for token in tokens if token.type == COMMENT}
    [definition] = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    fields = [node for node in definition.body if isinstance(node, ast.AnnAssign)]
    told: dict[str, str] = {}
    for field in fields:
        name, row, above = ast.unparse(field.target), field.lineno - 1, list[str]()
        while row in comments and comments[row][1].lstrip().startswith("#"):
            above.insert(0, comments[row][0])
            row -= 1
        text = " ".join(above)
        shared = re.match(r"(\w+(?:, \w+)+): ", text)
        if field.end_lineno in comments:
            told[name] = comments[field.end_lineno][0]
        elif shared:
            told |= dict.fromkeys(shared[1].split(", "), text.removeprefix(shared[0]))
        elif text:
            told[name] = text
    return {name: text if text.endswith(".") else f"{text}." for name, text in told.items()}


def messages() -> str:
    """Return the text of the page on messages: those of the modules, and what they contain."""
    kinds = dict[type[msgspec.Struct], None]()
    for module in (wire, status, sources):
        for kind in vars(module).values():
            if isinstance(kind, type) and issubclass(kind, msgspec.Struct) and kind.__module__ == module.__name__:
                kinds |= dict.fromkeys([kind, *_within(kind)])
    return MESSAGES_HEAD + "".join(map(_message, kinds))


def _within(kind: type[msgspec.Struct]) -> Iterator[type[msgspec.Struct]]:
    for annotation in typing.get_type_hints(kind).values():
        for inner in _structs(annotation):
            yield inner
            yield from _within(inner)


def _message(kind: type[msgspec.Struct]) -> str:
    """Return the section of one message; `schema` is described once, for all."""
    told, hints = _documented(kind), typing.get_type_hints(kind)
    about = " ".join((kind.__doc__ or "").partition("Attributes:")[0].split())
    fields = [field for field in msgspec.structs.fields(kind) if field.name != "schema"]
    rows = [f"| `{field.encode_name}` | {_form(hints[field.name])} | {told[field.name]} |" for field in fields]
    return (
        f"\n## {kind.__name__}\n\n{about}\n\n| field | type | meaning |\n| --- | --- | --- |\n" + "\n".join(rows) + "\n"
    )


_FORMS = {str: "text", int: "integer", float: "number", bool: "boolean", type(None): "null"}


def _form(annotation: object) -> str:
    """Return a type as JSON has it."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation in _FORMS:
        return _FORMS[annotation]  # pyright: ignore[reportArgumentType]
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    if origin in (types.UnionType, typing.Union):
        return " or ".join(map(_form, parts))
    if origin is typing.Literal:
        return ", ".join(f"`{part}`" for part in parts)
    if origin is tuple:
        return f"{len(parts)} {_several(parts[0])}"
    return f"{_form(parts[-1])} by name" if origin is dict else f"list of {_several(parts[0])}"


def _several(annotation: object) -> str:
    return f"{_form(annotation)}s" if annotation in (int, float, bool) else _form(annotation)


PAGES = {"robot_toml.md": robot_toml, "messages.md": messages}

if __name__ == "__main__":
    for name, page in PAGES.items():
        (FOLDER / name).write_text(page(), encoding="utf-8")
