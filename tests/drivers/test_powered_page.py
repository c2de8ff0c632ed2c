"""Statements of docs/zero_force.md agree with the code."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import msgspec
import pytest

from bodyschema.cli.main import command_line
from bodyschema.drivers.dynamixel.powered_config import GazeConfig, ZeroForceConfig

FILES = ("powered.py", "zero_force.py", "gaze.py", "guard.py")
ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "zero_force.md").read_text()
CODE = "".join((ROOT / "drivers" / "dynamixel" / name).read_text() for name in FILES)
TABLES = {"zero_force": ZeroForceConfig, "gaze": GazeConfig}


def block(name: str) -> str:
    found = re.search(rf"```toml\n([^`]*\[drivers\.dynamixel\.{name}\].*?)```", PAGE, re.DOTALL)
    assert found is not None
    return found[1]


@pytest.mark.parametrize("name", TABLES)
def test_documented_keys_match_the_config_fields(name) -> None:
    shown = re.sub(r"^# (?=[a-z_]+ =)", "", block(name), flags=re.MULTILINE)
    table = tomllib.loads(shown)["drivers"]["dynamixel"][name]
    msgspec.convert(table, TABLES[name])
    assert set(table) == {field.name for field in msgspec.structs.fields(TABLES[name])}


@pytest.mark.parametrize("name", TABLES)
def test_the_defaults_that_are_shown_are_the_defaults(name) -> None:
    defaults = {field.name: field.default for field in msgspec.structs.fields(TABLES[name])}
    shown = re.findall(r"^# (\w+) = ([\d.]+)\b", block(name), flags=re.MULTILINE)
    for key, value in shown:
        if key in defaults:
            assert float(value) == defaults[key]
    assert len(shown) >= 3


def test_documented_messages_exist_in_the_code() -> None:
    body = PAGE.partition("## Messages\n")[2].partition("\n## ")[0]
    shown = [
        text
        for row in re.findall(r"^\| (`.*?`(?:, `.*?`)*)", body, re.MULTILINE)
        for text in re.findall("`(.*?)`", row)
    ]
    parts = [part.strip(" °/s") for text in shown for part in re.split(r"\.\.\.|3, not current control \(0\)", text)]
    said = re.sub(r'"\s*\n\s*f?"', "", CODE)
    for part in parts:
        assert part in said, part
    assert len(shown) >= 3


@pytest.mark.parametrize("command", re.findall(r"^\$ (bodyschema .*)$", PAGE, re.MULTILINE))
def test_every_command_on_the_page_is_understood(command: str) -> None:
    words = command.split()[1:]
    understood, *_ = command_line(words[0]).parse_args(words, exit_on_error=False, print_error=False)
    assert callable(understood)
