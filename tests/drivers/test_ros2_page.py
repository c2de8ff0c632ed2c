"""ROS 2 examples in docs/hardware.md agree with the code."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import msgspec
import pytest

from bodyschema.drivers.config import DriversConfig

ROOT = Path(__file__).parents[2]
SECTION = (ROOT / "docs" / "hardware.md").read_text().split("\n## ROS 2 robots\n")[1].split("\n## ")[0]
CODE = re.sub(r'"\s+f?"', "", "".join(file.read_text() for file in (ROOT / "drivers" / "ros2").glob("*.py")))
MESSAGES = re.findall(r"^\| (`.*?`.*?) \|", SECTION.split("### Messages")[1].split("###")[0], re.MULTILINE)


def block(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", SECTION, re.DOTALL)
    assert found is not None
    return found[1]


@pytest.mark.parametrize("uncommented", [False, True])
def test_documented_tables_are_accepted_with_all_keys(uncommented) -> None:
    text = re.sub(r"^# (?=[a-z_]+ =)", "", block("toml"), flags=re.MULTILINE) if uncommented else block("toml")
    config = msgspec.convert(tomllib.loads(text)["drivers"], DriversConfig)
    config.check(["shoulder"], Path("robot.toml"), text)
    assert config.ros2 is not None


def test_the_defaults_that_are_shown_are_the_defaults() -> None:
    shown, plain = (
        msgspec.convert(tomllib.loads(text)["drivers"], DriversConfig)
        for text in (re.sub(r"^# (?=[a-z_]+ =)", "", block("toml"), flags=re.MULTILINE), block("toml"))
    )
    assert shown == plain


@pytest.mark.parametrize("message", MESSAGES)
def test_documented_messages_exist_in_the_driver(message) -> None:
    assert all(part in CODE for part in re.findall(r"`(.*?)`", message))


def test_there_are_messages_explained() -> None:
    assert len(MESSAGES) > 5


def test_emulator_starts_as_shown(capsys) -> None:
    exec(block("python"), {})
    assert "router and robot at" in capsys.readouterr().out
